"""Options that a real and a fake arm share, and what is made of them."""

import argparse
import contextlib
import importlib
import signal
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from envs import names
from lorasp_jax.base.arguments import positive
from lorasp_jax.base.locks import locked
from lorasp_jax.extras.piper.arms import dimension_names
from lorasp_jax.extras.piper.family import MODELS
from lorasp_jax.extras.piper.keys import SIGNALS
from lorasp_jax.extras.piper.log import Log
from lorasp_jax.extras.piper.recording import Recording
from lorasp_jax.extras.piper.remote import Server, own_robot
from lorasp_jax.extras.piper.rerun_log import Viewer, WatchedLog
from lorasp_jax.extras.piper.safety import Limits
from lorasp_jax.extras.piper.session import Session
from lorasp_jax.extras.piper.settings import Settings
from lorasp_jax.extras.piper.teaching import Lesson


def add_shared(parser: argparse.ArgumentParser) -> None:
    """Add the options of the server, the task, the execution and the limits."""
    add = parser.add_argument_group("policy").add_argument
    add("--server", default="ws://127.0.0.1:8000", help="address (default: %(default)s)")
    add("--token-file", type=Path, metavar="FILE", help="file with the server's token")
    add("--adapter", default="", metavar="NAME", help="one of the server's adapters; default: its "
        "first, or that of the prompt if the server chooses by it")  # fmt: skip
    add("--robot", help="robot of the policy's training; another than the arm is refused unless it "
        "is named here; default: the arm, such as piper, or bi_piper for two")  # fmt: skip
    add("--prompt", action="append", default=[], help="the request in words; several take turns; "
        "default: one of the task's")  # fmt: skip
    add("--patience", type=float, default=2.0, metavar="S", help="longest time to wait for an "
        "answer [s] (default: %(default)s)")  # fmt: skip
    add("--jpeg", type=int, metavar="QUALITY", help="send pictures as JPEG of this quality, 1 to "
        "100, for slow links; default: as they are")  # fmt: skip
    add = parser.add_argument_group("execution").add_argument
    add("--episodes", type=positive, default=1, help="default: %(default)s")
    add("--record", type=Path, metavar="FOLDER", help="add the episodes and their outcomes to an "
        "RLDS dataset, which train.py takes as --data.source")  # fmt: skip
    add("--execute", type=positive, default=5, help="actions of each chunk (default: %(default)s)")
    add("--ahead", type=int, default=0, help="actions before their end to ask for the next chunk; "
        "0: the arm waits for the answer (default: %(default)s)")  # fmt: skip
    add("--control-dt", type=float, metavar="S", help="duration of an action [s]; default: the "
        "policy's, or 0.1")  # fmt: skip
    add("--log", type=Path, metavar="FOLDER", help="default: logs/piper-TIME")
    add("--rerun", metavar="TARGET", help="show pictures, chunks, poses and latencies in Rerun: a "
        "folder for a recording of each episode, or a viewer's address such as "
        "rerun+http://127.0.0.1:9876/proxy")  # fmt: skip
    add = parser.add_argument_group("limits").add_argument
    add("--arm", choices=[*MODELS], default="piper", help="its model (default: %(default)s)")
    add("--speed", type=float, default=1.0, help="of the joints [rad/s] (default: %(default)s)")
    add(
        "--effort", type=int, default=1000, help="of the gripper [0.001 N m] (default: %(default)s)"
    )
    add("--zeros", choices=("sdk", "urdf"), default="sdk", help="a PiPER's zeros of joints 2 "
        "and 3, see docs/robot.md (default: %(default)s)")  # fmt: skip
    add("--box", type=float, nargs=6, metavar=("X0", "X1", "Y0", "Y1", "Z0", "Z1"),
        help="space for the finger tips in the base frame of each arm [m]")  # fmt: skip


def limits(options: argparse.Namespace) -> Limits:
    """Return the limits; raise ValueError if one is out of range."""
    box = {}
    if options.box:
        box = {"box_low": tuple(options.box[::2]), "box_high": tuple(options.box[1::2])}
    if options.zeros != "sdk" and options.arm != "piper":
        raise ValueError(f"--zeros {options.zeros} is for a piper: {options.arm} has its own")
    return Limits.of(MODELS[options.arm], speed=options.speed, zeros=options.zeros, **box)


def settings(options: argparse.Namespace, prompt: str, **more: Any) -> Settings:
    """Return the settings of a session; raise ValueError if one is out of range."""
    return Settings(
        prompt,
        control_dt=period(options),
        execute=options.execute,
        ahead=options.ahead,
        patience=options.patience,
        **more,
    )


def period(options: argparse.Namespace) -> float:
    """Return the duration of an action [s]."""
    return 0.1 if options.control_dt is None else options.control_dt


def tasks() -> list[str]:
    """Return the names of the environments' tasks, and of one for two arms, which they lack."""
    return [*names.names("task"), "hand_over"]


def task(name: str) -> Any:
    """Return the `Task` of this name; raise ValueError if there is none."""
    if name not in tasks():
        raise ValueError(f"unknown task {name!r}: choose from {', '.join(tasks())}")
    if name == "hand_over":
        return importlib.import_module("lorasp_jax.extras.piper.fake.hand_over").TASK
    return importlib.import_module(f"envs.tasks.{name}").TASK


def motion(options: argparse.Namespace) -> dict[str, Any]:
    """Return what `PiperArm` needs to know of the arm and the limits."""
    limits = {"speed": options.speed, "effort": options.effort, "zeros": options.zeros}
    return {"model": MODELS[options.arm], **limits}


def open_log(options: argparse.Namespace, server: Server | None) -> Log:
    """Open the log, and what shows it."""
    folder = options.log or Path("logs") / time.strftime("piper-%Y%m%d-%H%M%S")
    if not options.rerun:
        return Log(folder)
    viewer = Viewer(options.rerun, period(options))
    if server:
        server.heard = viewer.reply
    return WatchedLog(folder, viewer)


@contextlib.contextmanager
def recording(
    options: argparse.Namespace, task: Any, sides: Sequence[str] = ("",), **settings: Any
) -> Iterator[Recording | None]:
    """Open the dataset, if there is to be one, and keep other processes from writing it.

    Args:
        options: of the command.
        task: the `Task`, or None.
        sides: names of the arms.
        **settings: of `Recording`.
    """
    if not options.record:
        yield None
        return
    name, instructions = (task.name, task.instructions) if task else ("", ())
    with locked(options.record):
        yield Recording(
            options.record,
            task=name,
            instructions=instructions,
            control_dt=period(options),
            robot=own_robot(options, len(sides)),
            names=dimension_names(sides) if len(sides) > 1 else (),
            **settings,
        )


def stop_on_signals(session: Session | Lesson) -> None:
    """Let `SIGNALS` stop a session, in which the arm brakes and holds, or a lesson."""
    for number in SIGNALS:
        signal.signal(number, lambda *_: session.stop())
