"""Options that a real and a fake arm share, and what is made of them."""

import argparse
import contextlib
import importlib
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from envs import names
from lorasp_jax.base.locks import locked
from lorasp_jax.extras.piper.asking import Observation
from lorasp_jax.extras.piper.log import Log
from lorasp_jax.extras.piper.recording import Recording
from lorasp_jax.extras.piper.safety import Limits
from lorasp_jax.extras.piper.session import Session
from lorasp_jax.extras.piper.settings import Settings
from lorasp_jax.extras.piper.teaching import Lesson
from lorasp_jax.extras.serving.client import PolicyClient, PolicyError, ServerGone
from lorasp_jax.extras.serving.pictures import to_square

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)
"""Those that end or suspend a program, and so must stop the arm."""
_CONTINUATION = ("executed", "delay")  # keys for servers whose chunks continue the previous one
_WAIT = 300.0  # s to wait for a server that is still compiling


def add_shared(parser: argparse.ArgumentParser) -> None:
    """Add the options of the server, the task, the execution and the limits."""
    add = parser.add_argument_group("policy").add_argument
    add("--server", default="ws://127.0.0.1:8000", help="address (default: %(default)s)")
    add("--token-file", type=Path, metavar="FILE", help="file with the server's token")
    add("--adapter", default="", metavar="NAME", help="one of the server's adapters; default: its "
        "first")  # fmt: skip
    add("--prompt", default="", help="the request in words; default: one of the task's")
    add = parser.add_argument_group("execution").add_argument
    add("--execute", type=int, default=5, help="actions of each chunk (default: %(default)s)")
    add("--ahead", type=int, default=0, help="actions before their end to ask for the next chunk; "
        "0: the arm waits for the answer (default: %(default)s)")  # fmt: skip
    add("--control-dt", type=float, default=0.1, help="duration of an action [s] (default: 0.1)")
    add("--log", type=Path, metavar="FOLDER", help="default: logs/piper-TIME")
    add = parser.add_argument_group("limits").add_argument
    add("--speed", type=float, default=1.0, help="of the joints [rad/s] (default: %(default)s)")
    add(
        "--effort", type=int, default=1000, help="of the gripper [0.001 N m] (default: %(default)s)"
    )
    add("--zeros", choices=("sdk", "urdf"), default="sdk", help="the firmware's zeros of joints 2 "
        "and 3, see docs/robot.md (default: %(default)s)")  # fmt: skip
    add("--box", type=float, nargs=6, metavar=("X0", "X1", "Y0", "Y1", "Z0", "Z1"),
        help="space for the finger tips in the base frame [m]")  # fmt: skip


def limits(options: argparse.Namespace) -> Limits:
    """Return the limits; raise ValueError if one is out of range."""
    box = {}
    if options.box:
        box = {"box_low": tuple(options.box[::2]), "box_high": tuple(options.box[1::2])}
    return Limits.of(speed=options.speed, zeros=options.zeros, **box)


def settings(options: argparse.Namespace, prompt: str, **more: Any) -> Settings:
    """Return the settings of a session; raise ValueError if one is out of range."""
    return Settings(
        options.prompt or prompt,
        control_dt=options.control_dt,
        execute=options.execute,
        ahead=options.ahead,
        **more,
    )


def task(name: str) -> Any:
    """Return the `Task` of this name; raise ValueError if there is none."""
    names.check("task", name)
    return importlib.import_module(f"envs.tasks.{name}").TASK


def motion(options: argparse.Namespace) -> dict[str, Any]:
    """Return what `PiperArm` needs to know of the limits."""
    return {"speed": options.speed, "effort": options.effort, "zeros": options.zeros}


def open_log(options: argparse.Namespace) -> Log:
    """Open the log."""
    return Log(options.log or Path("logs") / time.strftime("piper-%Y%m%d-%H%M%S"))


@contextlib.contextmanager
def recording(
    options: argparse.Namespace, task: Any, **settings: Any
) -> Iterator[Recording | None]:
    """Open the dataset, if there is to be one, and keep other processes from writing it.

    Args:
        options: of the command.
        task: the `Task`, or None.
        **settings: of `Recording`.
    """
    if not options.record:
        yield None
        return
    name, instructions = (task.name, task.instructions) if task else ("task", ())
    with locked(options.record):
        yield Recording(
            options.record,
            task=name,
            instructions=instructions,
            control_dt=options.control_dt,
            **settings,
        )


def stop_on_signals(session: Session | Lesson) -> None:
    """Let `SIGNALS` stop a session, in which the arm brakes and holds, or a lesson."""
    for number in SIGNALS:
        signal.signal(number, lambda *_: session.stop())


class Server:
    """A policy server as the function that a session asks, one question at a time.

    Attributes:
        ended: why the connection has ended, in a sentence; None while it has not.
    """

    def __init__(self, client: PolicyClient, adapter: str = "") -> None:
        """Wrap a connection; raise ValueError if the server has no adapter of this name."""
        known = client.metadata.get("adapters", [])  # openpi's servers do not choose
        if adapter and adapter not in known:
            there = ", ".join(map(str, known)) or "none to choose from"
            raise ValueError(f"the server has no adapter {adapter!r}, but {there}")
        self._choice = {"adapter": adapter} if adapter else {}
        trained = client.metadata.get("instructions")  # openpi's servers do not say it
        answering = adapter or next(iter(known), "")
        self._instructions = trained.get(answering, []) if isinstance(trained, dict) else []
        self._client = client
        self._lock = threading.Lock()  # a question that nobody waits for any more may be open
        self.ended: str | None = None
        self._size = client.metadata.get("image_size")
        continues = client.metadata.get("execution", "naive") != "naive"
        self._unknown = () if continues else _CONTINUATION

    @property
    def metadata(self) -> dict[str, Any]:
        """The server's description of its policy."""
        return self._client.metadata

    def warn(self, prompts: Sequence[str]) -> None:
        """Warn if a prompt is new to the policy, as far as the server says what is not."""
        known = self._instructions
        if known and (new := [p for p in prompts if p not in known]):
            print(
                f"warning: the policy was not trained for {new[0]!r}, but for requests such as "
                f"{known[0]!r}",
                flush=True,
            )

    def reset(self) -> None:
        """Begin an episode with the next question, once no earlier one is open."""
        with self._lock:
            self._client.reset()

    def __call__(self, observation: Observation) -> np.ndarray:
        """Return the server's actions [C, 7]; its pictures are resized here, so less is sent.

        Raises:
            ServerGone, PolicyError: as `PolicyClient.infer`.
        """
        pictures = observation["image"]
        if isinstance(self._size, int) and self._size > 0:
            pictures = {name: to_square(name, x, self._size) for name, x in pictures.items()}
        known = {key: x for key, x in observation.items() if key not in self._unknown}
        try:
            with self._lock:
                reply = self._client.infer({**known, **self._choice, "image": pictures})
        except (ServerGone, PolicyError) as error:
            self.ended = self.ended or str(error)
            raise
        if "actions" not in reply:
            keys = ", ".join(map(str, reply))[:200] or "nothing"
            raise PolicyError(f"the server's reply has no actions, only {keys}")
        try:
            return np.asarray(reply["actions"])
        except ValueError as error:
            raise PolicyError("the server's actions are lists of different lengths") from error


@contextlib.contextmanager
def policy(options: argparse.Namespace) -> Iterator[Server]:
    """Connect to the server.

    Raises:
        ServerGone: there is no server.
        OSError: the token cannot be read.
    """
    token = options.token_file.read_text().strip() if options.token_file else ""
    print(f"connecting to {options.server}, for up to {_WAIT:g} s", flush=True)
    with PolicyClient(options.server, token=token, wait=_WAIT) as client:
        yield Server(client, options.adapter)
