"""Run a policy on a PiPER: `python -m lorasp_jax.extras.piper --task press --dry-run`."""

import argparse
import contextlib
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from lorasp_jax.base.arguments import pair
from lorasp_jax.base.errors import run_command
from lorasp_jax.extras.piper import options as shared
from lorasp_jax.extras.piper import remote
from lorasp_jax.extras.piper.arm import PiperArm
from lorasp_jax.extras.piper.asking import InThread
from lorasp_jax.extras.piper.cameras import open_cameras
from lorasp_jax.extras.piper.clock import RealClock
from lorasp_jax.extras.piper.recording import Recording
from lorasp_jax.extras.piper.safety import Unsafe
from lorasp_jax.extras.piper.session import Session
from lorasp_jax.extras.piper.settings import Settings
from lorasp_jax.extras.piper.teaching import Lesson

HELD = 3
"""Exit code after a problem in which the arm held."""


def main(arguments: Sequence[str], program: str = "python -m lorasp_jax.extras.piper") -> int:
    """Run one episode; return the exit code: `HELD`, or one of `lorasp_jax.base.errors`."""
    options = parser(program).parse_args(arguments)
    return run_command(lambda: _run(options), Console(stderr=True))


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
    add("--seconds", type=float, default=0.0, help="length; default: the task's limit, or 60")
    add("--dry-run", action="store_true", help="print commands instead of sending them")
    add("--record", type=Path, metavar="FOLDER", help="add the episode to an RLDS dataset, which "
        "train.py takes as --data.source")  # fmt: skip
    add("--teach", choices=("hand", "leader"), help="record what a person shows the arm, guided by "
        "hand or through a leader arm, in place of a policy")  # fmt: skip
    add("--image-size", type=int, default=224, help="of recorded pictures [px] (default: 224)")
    add = parser.add_argument_group("robot").add_argument
    add("--can", default="can0", help="CAN interface (default: %(default)s)")
    add("--bus", choices=("socketcan", "slcan"), default="socketcan", help="its kind "
        "(default: %(default)s)")  # fmt: skip
    add("--camera", action="append", type=pair, default=[], metavar="NAME=SOURCE", help="such as "
        "side=/dev/video0; once for each of the policy's cameras")  # fmt: skip
    shared.add_shared(parser)
    return parser


def _run(options: argparse.Namespace) -> int:
    task = shared.task(options.task) if options.task else None
    prompt = options.prompt or (task.instructions[0] if task else "")
    if not prompt:
        raise ValueError("pass --task or --prompt: the policy must be told what to do")
    if options.teach and not options.record:
        raise ValueError("--teach needs --record FOLDER")
    if options.record and options.dry_run:
        raise ValueError("--record has nothing to record in a --dry-run")
    settings = shared.settings(options, prompt, dry_run=options.dry_run)
    seconds = options.seconds or (task.time_limit if task else 60.0)
    with contextlib.ExitStack() as stack:
        server = None if options.teach else stack.enter_context(remote.policy(options))
        look = open_cameras(_sources(options, server), stack)
        if server:
            server.warn([prompt])
        recorder = stack.enter_context(
            shared.recording(options, task, prompt=prompt, image_size=options.image_size)
        )
        arm = PiperArm(options.can, bus=options.bus, **shared.motion(options))
        stack.callback(arm.close)
        arm.connect()
        if not (options.dry_run or options.teach == "leader"):
            arm.enable(shared.limits(options))
        if server:
            log = stack.enter_context(contextlib.closing(shared.open_log(options)))
            problem = _execute(options, settings, (arm, look, server, recorder, log), seconds)
        else:
            problem = _teach(options, (arm, look, recorder), seconds)
        if recorder and not problem:
            _keep(recorder)
        return HELD if problem else 0


def _execute(
    options: argparse.Namespace, settings: Settings, parts: tuple, seconds: float
) -> str | None:
    """Run the policy; return the problem in a sentence, if there is one."""
    arm, look, server, recorder, log = parts
    server.reset()
    more = {"recorder": recorder, "log": log}
    limits = shared.limits(options)
    session = Session(arm, look, InThread(server), limits, settings, RealClock(), **more)
    shared.stop_on_signals(session)
    return session.run(seconds)


def _teach(options: argparse.Namespace, parts: tuple, seconds: float) -> str | None:
    """Record a person; return the problem in a sentence, if there is one."""
    arm, look, recorder = parts
    way = {"way": options.teach, "control_dt": shared.period(options)}
    lesson = Lesson(arm, look, recorder, shared.limits(options), RealClock(), **way)
    shared.stop_on_signals(lesson)
    print("show the task, then press Ctrl-C")
    try:
        lesson.run(seconds)
    except Unsafe as error:
        print(f"recording ended: {error}")
        return str(error)
    return None


def _keep(recorder: Recording) -> None:
    """Let a person judge the episode; it is kept if nobody can.

    Raises:
        KeyboardInterrupt: Ctrl-C in place of an answer; the episode is not kept.
    """
    before = [signal.signal(number, _end_prompt) for number in shared.SIGNALS]
    answer, note = "y", ""
    try:
        answer = input(f"keep this episode of {recorder.steps} steps? [y/N] ").strip().lower()
    except (EOFError, OSError) as error:
        note = f"nobody answers ({error}), so the episode is kept: "
    finally:  # what is being written must not be interrupted
        for number, handler in zip(shared.SIGNALS, before, strict=True):
            signal.signal(number, handler)
    if answer == "y":
        recorder.keep()
        print(f"{note}{recorder.num_episodes} episodes recorded")


def _end_prompt(number: int, _: Any) -> None:
    if number == signal.SIGINT:
        raise KeyboardInterrupt("the episode is not kept")
    raise EOFError(signal.Signals(number).name)  # the terminal may be gone


def _sources(options: argparse.Namespace, server: remote.Server | None) -> dict[str, str]:
    """Return the cameras' sources after checking that there are those that the policy needs."""
    sources = dict(options.camera)
    needed = server.metadata.get("cameras", []) if server else list(sources)[:1] or ["side"]
    if missing := [name for name in needed if name not in sources]:
        examples = " ".join(f"--camera {name}=SOURCE" for name in missing)
        raise ValueError(
            f"cameras are needed for {', '.join(needed)}: pass {examples}, such as /dev/video0"
        )
    return sources


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
