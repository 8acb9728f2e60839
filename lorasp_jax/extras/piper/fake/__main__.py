"""Run a policy on the fake PiPER: `python -m lorasp_jax.extras.piper.fake --task press`."""

import argparse
import functools
import itertools
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from envs.rendering.video import side_by_side, write_video
from lorasp_jax.base import compilation_cache as cache
from lorasp_jax.base.arguments import not_negative, positive, seed
from lorasp_jax.base.errors import run_command
from lorasp_jax.base.intervals import wilson_interval
from lorasp_jax.extras.piper import options as shared
from lorasp_jax.extras.piper import remote
from lorasp_jax.extras.piper.arm import PiperArm
from lorasp_jax.extras.piper.arms import SIDES, Arms
from lorasp_jax.extras.piper.asking import InThread, InTurn
from lorasp_jax.extras.piper.fake.demonstrator import Demonstrator
from lorasp_jax.extras.piper.fake.firmware import PERIOD, FakePiper
from lorasp_jax.extras.piper.fake.hand_over import TASK, HandOver
from lorasp_jax.extras.piper.fake.timing import Lockstep, RealTime
from lorasp_jax.extras.piper.fake.world import TIMESTEP, World
from lorasp_jax.extras.piper.recording import Recording
from lorasp_jax.extras.piper.session import Session
from lorasp_jax.extras.serving.client import ServerGone

_LARGEST_LATENCY = 0.15  # s, of commands; our choice
_VIDEO_RATE = 10  # pictures per second
_VIDEO_HEIGHT = 256  # pixels, at least
_FRAME, _PAUSE = 32, 1.0  # part of the height; s between two episodes
_SETTLING = 0.3  # s, longer than a command can take
_CHANNELS = itertools.count()  # the SDK keeps one interface per name in a process


def main(arguments: Sequence[str], program: str = "python -m lorasp_jax.extras.piper.fake") -> int:
    """Run episodes; return the exit code, one of `lorasp_jax.base.errors`."""
    options = parser(program).parse_args(arguments)
    return run_command(lambda: _run(options, Console()))


def parser(program: str) -> argparse.ArgumentParser:
    """Return the argument parser of this command."""
    parser = argparse.ArgumentParser(
        prog=program,
        description="Run a policy on a PiPER in MuJoCo, through piper_sdk and a virtual CAN bus.",
        epilog="Time stands still while the policy thinks, unless --realtime is given.",
    )
    add = parser.add_argument
    add("--task", default="press", help=f"{', '.join(shared.tasks()[:-1])}, or "
        f"{shared.tasks()[-1]} for two arms (default: %(default)s)")  # fmt: skip
    add("--expert", action="store_true", help="the scripted expert in place of a server")
    add("--seed", type=seed, default=0, help="of the first layout (default: %(default)s)")
    add("--latency", type=float, default=0.0, help="of commands on their way to the motors [s], "
        f"at most {_LARGEST_LATENCY} (default: %(default)s)")  # fmt: skip
    add("--thinking", type=not_negative, default=0.0, help="time from observation to actions [s] "
        "(default: %(default)s)")  # fmt: skip
    add("--noise", type=not_negative, default=2e-4, help="of measured angles [rad] "
        "(default: %(default)s)")  # fmt: skip
    add("--realtime", action="store_true", help="let time run while the policy thinks")
    add("--image-size", type=positive, default=64, help="of pictures [px], for policies that do "
        "not say it (default: %(default)s)")  # fmt: skip
    add("--video", type=Path, metavar="FILE", help="MP4 of what the cameras see")
    shared.add_shared(parser)
    return parser


def _run(options: argparse.Namespace, console: Console) -> None:
    if not 0 <= options.latency <= _LARGEST_LATENCY:
        raise ValueError(f"--latency must be 0 to {_LARGEST_LATENCY} s, got {options.latency}")
    if options.arm != "piper":
        raise ValueError(f"the fake arm is a piper, not a {options.arm}")
    task = shared.task(options.task)
    shared.limits(options)
    shared.settings(options, "")
    cache.enable()
    scene, sides = (HandOver, SIDES) if task is TASK else (World, ("",))
    source = nullcontext() if options.expert else remote.policy(options, len(sides))
    with source as server, closing(shared.open_log(options, server)) as log:
        size = (server and server.metadata.get("image_size")) or options.image_size
        world = scene(options.task, image_size=size)
        world.reset(options.seed)
        if server:
            server.warn(options.prompt or world.instructions)
        settings = {"image_size": size, "physics_dt": TIMESTEP}
        prompt = (options.prompt or task.instructions)[0]
        with (
            _video(options.video) as film,
            _bench(options, world) as bench,
            shared.recording(options, task, sides, prompt=prompt, **settings) as recorder,
        ):
            bench.arms.connect()
            _episodes(options, bench, server, (log, recorder, film), console)


def _episodes(
    options: argparse.Namespace, bench: "Bench", server: Any, records: tuple, console: Console
) -> None:
    """Run and count episodes.

    Raises:
        ServerGone: the connection to the server ended; an episode that it cut short is not counted.
    """
    wins, (log, recorder, film) = 0, records
    limit = shared.task(options.task).time_limit
    for episode in range(options.episodes):
        bench.reset(options.seed + episode)
        log.line(bench.clock.now(), episode=episode)
        session = _session(options, bench, server, episode, records, console)
        world = bench.world
        problem = session.run(limit, _judge(world, film))
        wins += world.success
        if film:
            film += [_framed(film[-1], world.success)] * round(_PAUSE * _VIDEO_RATE)
        stopped = world.success or session.stopped
        ended = "" if stopped or not server else server.ended
        if recorder:
            lost = not server or bool(ended) or session.stopped
            _keep(recorder, world.success, lost=lost, problem=problem)
        if ended:
            before = f"before, {_result(wins, episode)}" if episode else "no episode was judged"
            raise ServerGone(f"stopped in episode {episode}, as {ended}; {before}")
        outcome = "success" if world.success else f"failure: {problem}" if problem else "failure"
        console.print(f"episode {episode}: {outcome}", markup=False, highlight=False)
        if session.stopped:
            raise KeyboardInterrupt
    console.print(_result(wins, options.episodes))


def _keep(recorder: Recording, success: bool, *, lost: bool, problem: str | None) -> None:
    """Record a success, or a policy's failure; forget what was cut short, or the expert's.

    A problem says nothing of the policy: the outcome is then unknown.
    """
    if recorder.steps and (success or not lost):
        recorder.keep(success or (None if problem else False))
    else:
        recorder.discard()


def _result(wins: int, episodes: int) -> str:
    low, high = wilson_interval(wins, episodes)
    return f"{wins} of {episodes} succeeded ({low:.0%} to {high:.0%})"


@contextmanager
def _video(path: Path | None) -> Iterator[list[np.ndarray] | None]:
    """Collect pictures, and write what there is of them however the episodes end."""
    film: list[np.ndarray] = []
    try:
        yield film if path else None
    finally:
        if path and film:
            path.parent.mkdir(parents=True, exist_ok=True)
            times = 2 * -(-_VIDEO_HEIGHT // (2 * len(film[0])))  # even, as videos must be
            write_video(path, np.stack(film), _VIDEO_RATE, times=times)


def _framed(picture: np.ndarray, success: bool) -> np.ndarray:
    """Return the last picture of an episode in a green frame after success, else in a red one."""
    color = (0, 160, 0) if success else (200, 0, 0)
    framed, edge = picture.copy(), max(1, len(picture) // _FRAME)
    framed[:edge] = framed[-edge:] = framed[:, :edge] = framed[:, -edge:] = color
    return framed


def _session(
    options: argparse.Namespace,
    bench: "Bench",
    server: Any,
    episode: int,
    records: tuple,
    console: Console,
) -> Session:
    """Enable the arms, and prepare an episode."""
    world, clock = bench.world, bench.clock
    bench.arms.enable()
    if server:
        server.reset()
    ask = server or Demonstrator(world, clock, options.seed + episode)
    asker = InThread(ask) if options.realtime else InTurn(ask, clock, options.thinking)
    prompts = options.prompt or [world.instruction]
    settings = shared.settings(options, prompts[episode % len(prompts)])
    log, recorder, _ = records
    if recorder:
        recorder.say(settings.prompt)
    say = functools.partial(console.print, markup=False, highlight=False, soft_wrap=True)
    more = {"log": log, "recorder": recorder, "say": say}
    session = Session(bench.arms, world.images, asker, settings, clock, **more)
    shared.stop_on_signals(session)
    return session


class Bench(NamedTuple):
    """Connected arms, the world of their fake other ends and their clock."""

    arms: Arms
    world: World
    clock: Lockstep | RealTime

    def reset(self, seed: int) -> None:
        """Start a new layout, and wait until the arms' drivers have noticed."""
        self.clock.reset(seed)
        self.clock.wait_until(self.clock.now() + _SETTLING)


@contextmanager
def _bench(options: argparse.Namespace, world: World) -> Iterator[Bench]:
    """Yield both ends of a bus for each arm."""
    fakes = {f"fake_piper_{next(_CHANNELS)}": limb for limb in world.limbs.values()}
    more = {"latency": options.latency, "noise": options.noise}
    ends = [
        FakePiper(channel, world, limb, seed=options.seed + number, **more)
        for number, (channel, limb) in enumerate(fakes.items())
    ]
    clock = RealTime(*ends) if options.realtime else Lockstep(*ends)
    motion = {"bus": "virtual", "clock": clock, **shared.motion(options)}
    drivers = [PiperArm(channel, **motion) for channel in fakes]
    arms = Arms(dict(zip(world.limbs, drivers, strict=True)), shared.limits(options))
    try:
        clock.start(*drivers)
        yield Bench(arms, world, clock)
    finally:
        clock.stop()
        arms.close()
        for end in ends:
            end.close()


def _judge(world: World, film: list[np.ndarray] | None) -> Callable[[], bool]:
    """Return a function for every tick that tests for success at every control step."""
    ticks, every = 0, round(world.control_dt / PERIOD)

    def done() -> bool:
        nonlocal ticks
        ticks += 1
        if ticks % every:
            return False
        if film is not None:
            film.append(side_by_side(world.images()))
        return world.judge()

    return done


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
