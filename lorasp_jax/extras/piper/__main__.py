"""Run a policy on a PiPER: `python -m lorasp_jax.extras.piper --task press --dry-run`."""

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from typing import Any, NamedTuple

from rich.console import Console

from lorasp_jax.base.arguments import not_negative, pair, positive
from lorasp_jax.base.errors import report_error, run_command
from lorasp_jax.extras.piper import options as shared
from lorasp_jax.extras.piper import remote
from lorasp_jax.extras.piper.arm import NoArm, PiperArm
from lorasp_jax.extras.piper.arms import SIDES, Arms
from lorasp_jax.extras.piper.asking import InThread
from lorasp_jax.extras.piper.cameras import Look, open_cameras
from lorasp_jax.extras.piper.clock import RealClock
from lorasp_jax.extras.piper.keys import Keyboard
from lorasp_jax.extras.piper.log import Log
from lorasp_jax.extras.piper.recording import Recording
from lorasp_jax.extras.piper.safety import Unsafe
from lorasp_jax.extras.piper.session import Session
from lorasp_jax.extras.piper.teaching import Lesson

HELD = 3
"""Exit code after a problem in which the arm held."""
KEYS = "sfaq"
"""Keyboard of a person's verdict on an episode, which also end it."""
TAKE = "t"
"""Key with which a person takes over from a recorded policy, by hand."""
QUESTION = "success (s), failure (f), again (a) or quit (q)?"


def main(arguments: Sequence[str], program: str = "python -m lorasp_jax.extras.piper") -> int:
    """Run episodes; return the exit code: `HELD`, or one of `lorasp_jax.base.errors`."""
    options = parser(program).parse_args(arguments)
    return run_command(lambda: _run(options))


def parser(program: str) -> argparse.ArgumentParser:
    """Return the argument parser of this command."""
    parser = argparse.ArgumentParser(
        prog=program,
        description="Run a policy on an AgileX PiPER, or record demonstrations. "
        "Read docs/robot.md first.",
        epilog="Ctrl-C brakes and holds. An emergency stop lets the arm sink: keep it for people.",
    )
    add = parser.add_argument
    add("--task", default="", help="one of the simulation's tasks, for its request and time limit")
    add("--seconds", type=not_negative, default=0.0, help="length; default: the task's limit, or "
        "60")  # fmt: skip
    add("--dry-run", action="store_true", help="print commands instead of sending them; needs no "
        "arm, unless --can names one to read")  # fmt: skip
    add("--reset-time", type=not_negative, metavar="S", help="time between two episodes to put "
        "the scene back [s]; default: until you press a key")  # fmt: skip
    add("--teach", choices=("hand", "leader"), help="record what a person shows the arm, guided by "
        "hand or through a leader arm, in place of a policy")  # fmt: skip
    add("--image-size", type=positive, default=224, help="of recorded pictures [px] (default: 224)")
    add = parser.add_argument_group("robot").add_argument
    add("--can", nargs="+", default=[], metavar="INTERFACE", help="CAN interface (default: can0); "
        "left=can0 right=can1 for two arms")  # fmt: skip
    add("--bus", choices=("socketcan", "slcan"), default="socketcan", help="its kind "
        "(default: %(default)s)")  # fmt: skip
    add("--camera", action="append", type=pair, default=[], metavar="NAME=SOURCE", help="such as "
        "side=/dev/video0; once for each of the policy's cameras")  # fmt: skip
    add("--camera-size", default="640x480", help="that devices are asked for (default: "
        "%(default)s)")  # fmt: skip
    add("--camera-rate", default="30", help="the same, pictures per second (default: %(default)s)")
    add("--camera-format", default="", help="the same, ffmpeg's input_format such as mjpeg or "
        "yuyv422; default: the driver's choice")  # fmt: skip
    shared.add_shared(parser)
    return parser


class Rig(NamedTuple):
    """What episodes need; server and log are None if a person teaches."""

    arms: Arms
    look: Look
    server: remote.Server | None
    recorder: Recording | None
    log: Log | None
    keys: Keyboard


def _run(options: argparse.Namespace) -> int:
    task = shared.task(options.task) if options.task else None
    prompts = options.prompt or ([task.instructions[0]] if task else [])
    if not all(prompts or [""]):
        raise ValueError("pass --task or --prompt: the policy must be told what to do")
    if options.teach and not options.record:
        raise ValueError("--teach needs --record FOLDER")
    if options.teach and options.rerun:
        raise ValueError("--rerun shows what a policy does: leave it out with --teach")
    if options.record and options.dry_run:
        raise ValueError("--record has nothing to record in a --dry-run")
    shared.settings(options, prompts[0])
    shared.limits(options)
    seconds, code = options.seconds or (task.time_limit if task else 60.0), 0
    try:
        with ExitStack() as stack:
            rig = _connect(options, stack, task, prompts)
            code = _episodes(options, rig, prompts, seconds)
    except Exception as error:
        if code != HELD:
            raise
        report_error(error, Console(stderr=True))  # an incomplete recording hides no problem
    return code


def _connect(
    options: argparse.Namespace, stack: ExitStack, task: Any, prompts: Sequence[str]
) -> Rig:
    """Open all that episodes need, and enable the arms."""
    buses = _buses(options)
    server = None
    if not options.teach:
        server = stack.enter_context(remote.policy(options, len(buses)))
    device = {"video_size": options.camera_size, "framerate": options.camera_rate}
    if options.camera_format:
        device["input_format"] = options.camera_format
    look = open_cameras(_sources(options, server), stack, device)
    if server:
        server.warn(prompts)
    more = {"prompt": prompts[0], "image_size": options.image_size}
    recorder = stack.enter_context(shared.recording(options, task, [*buses], **more))
    log = stack.enter_context(closing(shared.open_log(options, server))) if server else None
    arms = _open(options, buses, server)
    stack.callback(arms.close)
    arms.connect()
    if not (options.dry_run or options.teach == "leader"):
        arms.enable()
    return Rig(arms, look, server, recorder, log, stack.enter_context(Keyboard()))


def _buses(options: argparse.Namespace) -> dict[str, str]:
    """Return name of the arm -> interface: "" for a single arm, none in a dry run without any."""
    given: list[str] = [text for text in options.can or [] if text] or (
        [] if options.dry_run else ["can0"]
    )
    if len(given) < 2 and "=" not in "".join(given):
        return dict.fromkeys([""], given[0]) if given else {}
    buses = {name: can for name, _, can in (text.partition("=") for text in given)}
    if {*buses} != {*SIDES} or not all(buses.values()) or len({*buses.values()}) < len(given):
        raise ValueError(
            "--can takes one interface, or two for two arms as left=can0 right=can1, got "
            f"{' '.join(given)}"
        )
    return {side: buses[side] for side in SIDES}


def _open(
    options: argparse.Namespace, buses: Mapping[str, str], server: remote.Server | None
) -> Arms:
    """Open the buses; in a dry run without any, the policy says how many arms there are."""
    limits = shared.limits(options)
    if not buses:
        print("a dry run without an arm: it stands in the start pose")
        two = server and remote.arms_of(server.metadata) == 2
        return Arms({side: NoArm(limits.model) for side in (SIDES if two else [""])}, limits)
    motion = {"bus": options.bus, **shared.motion(options)}
    return Arms({side: PiperArm(can, **motion) for side, can in buses.items()}, limits)


def _episodes(options: argparse.Namespace, rig: Rig, prompts: Sequence[str], seconds: float) -> int:
    """Run until enough episodes were judged, or demonstrated; return the exit code."""
    start, judged, kept = rig.arms.read(), 0, 0
    judging = bool(rig.recorder) or options.episodes > 1
    work: Session | Lesson | None = None
    while True:
        prompt = prompts[(kept if options.teach else judged) % len(prompts)]
        before, work = work, _prepare(options, rig, prompt)
        shared.stop_on_signals(work)
        if rig.log:
            rig.log.line(RealClock().now(), episode=judged)
        if before and before.stopped:  # meanwhile
            break
        verdict, work, problem = _run_episode(options, rig, work, seconds, judging=judging)
        if problem:
            return HELD
        if judging:
            verdict = _keep(rig, verdict)
            judged, kept = judged + (verdict in ("s", "f")), kept + (verdict == "s")
        enough = (kept if options.teach else judged) >= options.episodes
        if not judging or enough or work.stopped or verdict == "q" or rig.keys.ended:
            break
        if rig.server and isinstance(work, Lesson):
            print("the policy can go on after a reset of the arm: see docs/robot.md")
            break
        if isinstance(work, Session) and work.home(start):
            return HELD
        if work.stopped or not _reset(options, rig):
            break
    if options.episodes > 1:
        print(f"{kept} of {judged} succeeded")
    return 0


def _run_episode(
    options: argparse.Namespace,
    rig: Rig,
    work: Session | Lesson,
    seconds: float,
    *,
    judging: bool,
) -> tuple[str, Session | Lesson, str | None]:
    """Run an episode, which a person may take over from a recorded policy.

    Returns:
        The verdict by key, if there is one; what ended the episode; and the problem, if any.
    """
    verdict, keys = "", KEYS + TAKE * bool(rig.server and rig.recorder and rig.recorder.marks)
    while judging and rig.keys.pressed():
        pass  # what was typed before is no verdict

    def done() -> bool:
        nonlocal verdict
        verdict = verdict or (key if judging and (key := rig.keys.pressed()) in keys else "")
        return bool(verdict)

    problem = _execute(work, seconds, done)
    if verdict == TAKE and not problem:
        before, verdict, keys, work = work, "", KEYS, _take_over(options, rig)
        shared.stop_on_signals(work)
        if before.stopped:  # while the arm braked
            return verdict, before, None
        print(f"take over: guide the arm by hand, then press a key: {QUESTION}", flush=True)
        problem = _execute(work, seconds, done)
    return verdict, work, problem


def _reset(options: argparse.Namespace, rig: Rig) -> bool:
    """Give a person time for the scene; return whether there is to be another episode."""
    try:
        sentence = "put the scene back, then press Enter, or q to quit"
        return rig.keys.ask(sentence, "\nq", options.reset_time) != "q"
    except EOFError:
        return False


def _prepare(options: argparse.Namespace, rig: Rig, prompt: str) -> Session | Lesson:
    """Return the next episode: a policy's, or a lesson."""
    clock = RealClock()
    print(f"next: {prompt}", flush=True)
    if rig.recorder:
        rig.recorder.say(prompt)
    if rig.server:
        rig.server.reset()
        settings = shared.settings(options, prompt, dry_run=options.dry_run)
        more = {"recorder": rig.recorder, "log": rig.log}
        return Session(rig.arms, rig.look, InThread(rig.server), settings, clock, **more)
    assert rig.recorder
    way = {"way": options.teach, "control_dt": shared.period(options)}
    print(f"show the task, then press a key: {QUESTION}")
    return Lesson(rig.arms, rig.look, rig.recorder, clock, **way)


def _take_over(options: argparse.Namespace, rig: Rig) -> Lesson:
    """Return the rest of a policy's episode, in which a person guides the arm by hand."""
    assert rig.recorder
    how = {"way": "hand", "control_dt": shared.period(options), "corrects": True}
    return Lesson(rig.arms, rig.look, rig.recorder, RealClock(), **how)


def _execute(work: Session | Lesson, seconds: float, done: Callable[[], bool]) -> str | None:
    """Run an episode; return the problem in a sentence, if there is one."""
    if isinstance(work, Session):
        return work.run(seconds, done)
    try:
        work.run(seconds, done)
    except Unsafe as error:
        print(f"recording ended: {error}")
        return str(error)
    return None


def _keep(rig: Rig, verdict: str) -> str:
    """Return a person's verdict on the episode, after recording it with its outcome.

    A demonstration that failed is not kept. An episode that nobody can judge is, and is the last.

    Raises:
        KeyboardInterrupt: Ctrl-C in place of an answer; the episode is not kept.
    """
    note, recorder = "", rig.recorder
    try:
        verdict = verdict or rig.keys.ask(QUESTION, KEYS)
    except EOFError as error:
        verdict, note = "", f"nobody answers ({error}), so the episode is kept: "
        rig.keys.ended = True
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt("the episode is not kept") from stop
    if recorder and verdict == "f" and not (rig.server and recorder.steps):
        recorder.fail()
    elif recorder and verdict in ("a", "q"):
        recorder.discard()
    elif recorder:
        recorder.keep({"s": True, "f": False}.get(verdict))
        print(f"{note}{recorder.num_episodes} episodes recorded")
    return verdict


def _sources(options: argparse.Namespace, server: remote.Server | None) -> dict[str, str]:
    """Return the cameras' sources after checking that there are those that the policy needs."""
    sources = dict(options.camera)
    needed = (server.metadata.get("cameras") or []) if server else list(sources)[:1] or ["side"]
    if missing := [name for name in needed if name not in sources]:
        examples = " ".join(f"--camera {name}=SOURCE" for name in missing)
        raise ValueError(
            f"cameras are needed for {', '.join(needed)}: pass {examples}, such as /dev/video0"
        )
    return sources


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
