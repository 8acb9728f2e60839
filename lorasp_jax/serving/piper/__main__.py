"""Run a policy on a PiPER: `python -m lorasp_jax.serving.piper --task press --dry-run`."""

import argparse
import sys
from collections.abc import Sequence

from rich.console import Console

from envs.cli.errors import parse_arguments, run_command
from lorasp_jax.serving.piper import options as shared
from lorasp_jax.serving.piper.arm import PiperArm
from lorasp_jax.serving.piper.asking import InThread
from lorasp_jax.serving.piper.cameras import OpenCameras
from lorasp_jax.serving.piper.clock import RealClock
from lorasp_jax.serving.piper.session import Session

HELD = 3
"""Exit code after a problem in which the arm held."""


def main(arguments: Sequence[str], program: str = "python -m lorasp_jax.serving.piper") -> int:
    """Run one episode; return the exit code: `HELD`, or one of `envs.cli.errors`."""
    options = parse_arguments(parser(program), arguments)
    return run_command(lambda: _run(options), Console(stderr=True))


def parser(program: str) -> argparse.ArgumentParser:
    """Return the argument parser of this command."""
    parser = argparse.ArgumentParser(
        prog=program,
        description="Run a policy on an AgileX PiPER.",
        epilog="Ctrl-C brakes and holds. An emergency stop lets the arm sink: keep it for people.",
    )
    add = parser.add_argument
    add("--task", default="", help="one of the simulation's tasks, for its request and time limit")
    add("--seconds", type=float, default=0.0, help="length; default: the task's limit, or 60")
    add("--dry-run", action="store_true", help="print commands instead of sending them")
    add = parser.add_argument_group("robot").add_argument
    add("--can", default="can0", help="CAN interface (default: %(default)s)")
    add("--bus", default="socketcan", help="its kind: socketcan or slcan (default: %(default)s)")
    add("--camera", action="append", default=[], metavar="NAME=SOURCE", help="such as "
        "side=/dev/video0; once for each of the policy's cameras")  # fmt: skip
    shared.add_shared(parser)
    return parser


def _run(options: argparse.Namespace) -> int:
    task = shared.task(options.task) if options.task else None
    if not (options.prompt or task):
        raise ValueError("pass --task or --prompt: the policy must be told what to do")
    settings = shared.settings(
        options, task.instructions[0] if task else "", dry_run=options.dry_run
    )
    seconds = options.seconds or (task.time_limit if task else 60.0)
    limits, clock = shared.limits(options), RealClock()
    sources = dict(_pair(text) for text in options.camera)
    with shared.policy(options) as server:
        server.reset()
        _check_cameras(sources, server.metadata.get("cameras", []))
        cameras = OpenCameras(sources)
        arm = _arm(options, clock)
        try:
            if not options.dry_run:
                arm.enable(limits)
            with shared.opened_log(options) as log:
                session = Session(arm, cameras, InThread(server), limits, settings, clock, log=log)
                shared.stop_on_signals(session)
                return HELD if session.run(seconds) else 0
        finally:
            cameras.close()
            arm.close()


def _arm(options: argparse.Namespace, clock: RealClock) -> PiperArm:
    arm = PiperArm(
        options.can,
        bus=options.bus,
        speed=options.speed,
        effort=options.effort,
        zeros=options.zeros,
        clock=clock,
    )
    arm.connect()
    return arm


def _check_cameras(sources: dict[str, str], needed: Sequence[str]) -> None:
    if missing := [name for name in needed if name not in sources]:
        example = f"--camera {missing[0]}=/dev/video0"
        raise ValueError(f"the policy looks through {', '.join(needed)}: pass {example}")


def _pair(text: str) -> tuple[str, str]:
    name, equals, source = text.partition("=")
    if not (name and equals and source):
        raise ValueError(f"--camera must be NAME=SOURCE, got {text!r}")
    return name, source


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
