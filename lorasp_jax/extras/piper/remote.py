"""The policy's server, as the client of an arm sees it."""

import argparse
import contextlib
import functools
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from lorasp_jax.base import json_values
from lorasp_jax.extras.piper.asking import Observation
from lorasp_jax.extras.serving.client import PolicyClient, PolicyError, ServerGone
from lorasp_jax.extras.serving.pictures import to_square

_CONTINUATION = ("executed", "delay")  # keys for servers whose chunks continue the previous one
_WAIT = 300.0  # s to wait for a server that is still compiling
_SCHEMA = {"robot?": str, "control_dt?": float, "action_dim?": int, "image_size?": int}
_SCHEMA |= {"cameras?": [str], "adapters?": [str], "instructions?": {str: [str]}, "execution?": str}
_SCHEMA |= {"route?": str}


class Server:
    """A policy server as the function that a session asks, one question at a time.

    Attributes:
        ended: why the connection has ended, in a sentence; None while it has not.
        heard: is told of every reply, in the thread that asks.
    """

    def __init__(self, client: PolicyClient, adapter: str = "") -> None:
        """Wrap a connection; raise ValueError if the server has no adapter of this name."""
        known = client.metadata.get("adapters") or []  # openpi's servers do not choose
        if adapter and adapter not in known:
            there = ", ".join(map(str, known)) or "none to choose from"
            raise ValueError(f"the server has no adapter {adapter!r}, but {there}")
        self._choice = {"adapter": adapter} if adapter else {}
        trained = client.metadata.get("instructions") or {}
        routed = (client.metadata.get("route") or "name") != "name"  # by the prompt
        may_answer = [adapter] if adapter else known if routed else known[:1]
        self._instructions = [text for name in may_answer for text in trained.get(name, [])]
        self._client = client
        self._lock = threading.Lock()  # a question that nobody waits for any more may be open
        self.ended: str | None = None
        self.heard: Callable[[dict[str, Any]], None] = lambda _: None
        self._size = client.metadata.get("image_size") or 0
        continues = (client.metadata.get("execution") or "naive") != "naive"
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
        """Return the server's actions [C, 7 N]; its pictures are resized here, so less is sent.

        Raises:
            ServerGone, PolicyError: as `PolicyClient.infer`.
        """
        pictures = observation["image"]
        if self._size > 0:
            pictures = {name: to_square(name, x, self._size) for name, x in pictures.items()}
        known = {key: x for key, x in observation.items() if key not in self._unknown}
        try:
            with self._lock:
                reply = self._client.infer({**known, **self._choice, "image": pictures})
        except (ServerGone, PolicyError) as error:
            self.ended = self.ended or str(error)
            raise
        self.heard(reply)
        if "actions" not in reply:
            keys = ", ".join(map(str, reply))[:200] or "nothing"
            raise PolicyError(f"the server's reply has no actions, only {keys}")
        try:
            return np.asarray(reply["actions"])
        except ValueError as error:
            raise PolicyError("the server's actions are lists of different lengths") from error


def own_robot(options: argparse.Namespace, arms: int) -> str:
    """Return the name of one or two arms, as LeRobot names its two-armed robots: bi_piper."""
    return "bi_" * (arms == 2) + options.arm


@contextlib.contextmanager
def policy(options: argparse.Namespace, arms: int = 1) -> Iterator[Server]:
    """Connect to the server, and let an action last as long as in its policy's training.

    Args:
        options: of the command.
        arms: number of arms that the policy is to move; 0: as many as it can.

    Raises:
        ServerGone: there is no server.
        OSError: the token cannot be read.
        ValueError: the policy is of another robot or of another size, or the server does not read
            JPEG.
    """
    token = options.token_file.read_text().strip() if options.token_file else ""
    say = functools.partial(print, flush=True)
    settings = {"token": token, "wait": _WAIT, "jpeg": options.jpeg, "say": say}
    with PolicyClient(options.server, **settings) as client:
        try:
            json_values.check(client.metadata, _SCHEMA, nulls=True)
        except ValueError as error:
            raise ValueError(f"the metadata of {options.server} are malformed: {error}") from error
        options.control_dt = _period(options, client.metadata, arms)
        yield Server(client, options.adapter)


def arms_of(metadata: dict[str, Any]) -> int:
    """Return how many arms a policy moves, as far as it says."""
    return 2 if metadata.get("action_dim") == 14 else 1


def _period(options: argparse.Namespace, metadata: dict[str, Any], arms: int) -> float | None:
    """Return the duration of an action [s], after comparing the policy with the arm."""
    arms = arms or arms_of(metadata)
    size = metadata.get("action_dim") or 7 * arms
    expected = options.robot or own_robot(options, arms)
    robot = metadata.get("robot") or expected
    if size != 7 * arms:
        takes = "a PiPER takes 7" if arms == 1 else f"{arms} PiPERs take {7 * arms}"
        remedy = ": two arms are --can left=can0 right=can1" if size == 14 else ""
        raise ValueError(f"the policy's actions have {size} numbers, but {takes}{remedy}")
    if robot != expected:
        raise ValueError(
            f"the policy is of the robot {robot}, not of {expected}: pass --robot {robot} to "
            "run it nevertheless"
        )
    trained, given = metadata.get("control_dt"), options.control_dt
    if trained and given and abs(trained - given) > 1e-6:
        print(f"warning: the policy acts every {trained:g} s, not every {given:g} s", flush=True)
    return given or trained
