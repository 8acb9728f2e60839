"""A policy's pilot without ROS: the newest pictures and joint states in, joint targets out.

It holds by falling silent: a position controller keeps its last target, which is at most `speed`
times one period ahead of the previous one. It does not send the measured position instead. That
lags behind the target, so the arm would jerk back and sag under its load; and where the state is
what has gone stale, it would send the arm to where it was long ago.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path as File
from typing import Any

import numpy as np

from lorasp_jax.base.arguments import pair
from lorasp_jax.base.errors import describe_any
from lorasp_jax.extras.piper.interpolation import Path
from lorasp_jax.extras.serving import jpeg
from lorasp_jax.extras.serving.client import PolicyClient, PolicyError

PIPER = ("joint1", "joint2", "joint3", "joint4", "joint5", "joint6", "gripper")
"""Names of AgileX's piper_ros."""
RETRY = 1.0
"""Time from a failed question to the next [s]."""


@dataclass(frozen=True)
class Settings:
    """What a policy sees and how its actions are executed.

    Attributes:
        cameras: the policy's names of its cameras.
        joints: names in the order of the policy's state and actions.
        prompt: the request in words.
        control_dt: duration of an action [s].
        execute: actions of a chunk that pass before the next chunk is asked for.
        patience: how long after these actions the chunk is still followed, if it has more [s]; also
            the longest time to wait for an answer.
        picture_age, state_age: ages beyond which pictures and joint states are stale [s].
        speed: largest change of a target [rad/s, m/s].
    """

    cameras: Sequence[str]
    prompt: str
    joints: Sequence[str] = PIPER
    control_dt: float = 0.1
    execute: int = 5
    patience: float = 0.5
    picture_age: float = 0.3
    state_age: float = 0.1
    speed: float = 0.5

    def __post_init__(self) -> None:
        """Raise ValueError unless all numbers are positive."""
        for name, value in vars(self).items():
            if isinstance(value, int | float) and not 0 < value < math.inf:
                raise ValueError(f"{name} must be positive, got {value:g}")


class Pilot:
    """Turns the newest pictures and joint states into targets. All times are of one clock [s].

    Action i of a chunk is reached i + 1 control steps after the chunk was asked for, so the arm
    does not wait for answers; actions that pass meanwhile are skipped.

    Attributes:
        holding: why there are no targets, in a sentence; None while there are.
    """

    def __init__(self, ask: Callable[[Mapping[str, Any]], Any], settings: Settings) -> None:
        """Create a pilot; `ask` returns actions [C, J] for a request, or raises anything."""
        self.holding: str | None = None
        self._ask, self._settings = ask, settings
        self._pictures: dict[str, tuple[float, Any]] = {}
        self._joints: dict[str, tuple[float, float]] = {}
        self._thread = ThreadPoolExecutor(1)  # so that there is one question at a time
        self._open: tuple[Future[Any], float, np.ndarray] | None = None
        self._path: Path | None = None
        self._last: np.ndarray | None = None
        self._since, self._retry, self._failure = 0.0, -math.inf, ""

    def see(self, camera: str, picture: Any, stamp: float) -> None:
        """Take a picture, as the server reads it."""
        self._pictures[camera] = stamp, picture

    def feel(self, names: Sequence[str], positions: Sequence[float], stamp: float) -> None:
        """Take joint positions [rad, m], of all joints or of some."""
        measured = dict(zip(names, positions, strict=False))
        self._joints |= {name: (stamp, x) for name, x in measured.items() if math.isfinite(x)}

    def tick(self, now: float, period: float) -> np.ndarray | None:
        """Return the target [J] for the next `period` seconds; None: publish nothing."""
        self._receive(now)
        self.holding = self._stale(now)
        if not self.holding:
            if self._wants_actions(now):
                self._question(now)
            self.holding = self._without_actions(now)
        if self.holding or self._path is None:
            self._path = self._last = None
            return None
        step = self._settings.speed * period
        wanted = self._path.target(now + period - self._since)
        last = self._state() if self._last is None else self._last
        self._last = last + np.clip(wanted - last, -step, step)
        return self._last

    def _state(self) -> np.ndarray:
        return np.array([self._joints[name][1] for name in self._settings.joints])

    def _stale(self, now: float) -> str | None:
        """Say which picture or joint is missing or stale; its stamp may also be ahead."""
        settings = self._settings
        kinds = (
            ("camera", settings.cameras, self._pictures, settings.picture_age),
            ("joint", settings.joints, self._joints, settings.state_age),
        )
        for kind, names, received, limit in kinds:
            for name in names:
                if name not in received:
                    return f"nothing from the {kind} {name} yet"
                if not abs(now - received[name][0]) <= limit:
                    return f"the {kind} {name} is not of the last {limit:g} s"
        return None

    def _wants_actions(self, now: float) -> bool:
        if self._open or now < self._retry:
            return False
        used = now - self._since >= self._settings.execute * self._settings.control_dt
        return self._path is None or used

    def _question(self, now: float) -> None:
        settings, state = self._settings, self._state()
        images = {name: self._pictures[name][1] for name in settings.cameras}
        request = {"image": images, "state": state.astype(np.float32), "prompt": settings.prompt}
        self._open = self._thread.submit(self._ask, request), now, state

    def _receive(self, now: float) -> None:
        """Follow an answer that has come, or drop the path if it cannot be followed."""
        if self._open is None or not self._open[0].done():
            return
        (answer, self._since, state), self._open = self._open, None
        try:
            actions = check(answer.result(), len(self._settings.joints))
            self._path, self._failure = Path(state, actions, self._settings.control_dt), ""
        except Exception as error:  # whatever it is, the arm must hold
            self._path, self._retry = None, now + RETRY
            self._failure = f"no actions: {describe_any(error)}"

    def _without_actions(self, now: float) -> str | None:
        """Say why there are no actions for now."""
        if self._path is None:
            return self._failure or "waiting for actions"
        settings = self._settings
        followed = settings.execute * settings.control_dt + settings.patience
        limit = min(self._path.steps * settings.control_dt, followed)
        fresh = 0 <= now - self._since < limit
        return None if fresh else f"the actions are not of the last {limit:g} s"


def check(actions: Any, joints: int) -> np.ndarray:
    """Return a server's actions as f64 [C, J]; raise ValueError if they are none."""
    chunk = np.asarray(actions, float)
    if chunk.ndim != 2 or chunk.shape[1] != joints or not len(chunk):
        raise ValueError(f"actions must be [C, {joints}], got {list(chunk.shape)}")
    if not np.isfinite(chunk).all():
        raise ValueError("actions must be finite")
    return chunk


class Server:
    """A policy server as the function that a `Pilot` asks; it connects again if it was lost."""

    def __init__(self, address: str, token: str, patience: float, wait: float) -> None:
        """Connect, trying for `wait` seconds; raise ServerGone if there is no server."""
        self._options = {"token": token, "timeout": max(patience, 0.1)}
        self._address = address
        self._client: PolicyClient | None = PolicyClient(address, wait=wait, **self._options)
        self.metadata: dict[str, Any] = self._client.metadata
        self._reads_jpeg = "jpeg" in (self.metadata.get("encodings") or ())

    def __call__(self, request: Mapping[str, Any]) -> Any:
        """Return the actions; pictures are JPEG files, which openpi's servers get decoded."""
        images = request["image"]
        if not self._reads_jpeg:
            images = {name: jpeg.decode(name, data) for name, data in images.items()}
        try:
            self._client = self._client or self._again()
            reply = self._client.infer({**request, "image": images})
        except Exception:
            if self._client:
                self._client.close()
            self._client = None
            raise
        if "actions" not in reply:
            raise PolicyError("the server's reply has no actions")
        return reply["actions"]

    def _again(self) -> PolicyClient:
        """Connect again; raise PolicyError if another policy is served now."""
        client = PolicyClient(self._address, **self._options)
        for name in ("robot", "action_dim", "control_dt", "cameras", "encodings"):
            if (now := client.metadata.get(name)) != (before := self.metadata.get(name)):
                client.close()
                raise PolicyError(f"the server came back with {name} {now}, not {before}")
        return client


def connect(parameter: Callable[[str, Any], Any]) -> tuple[Server, dict[str, str], Settings]:
    """Connect to a server, and compare its policy with the robot.

    Args:
        parameter: returns the value of a parameter that has a name and a default.

    Returns:
        The server, camera -> topic, and the settings.

    Raises:
        ArgumentTypeError: a camera is not of the form NAME=TOPIC.
        ValueError: a camera or the prompt is missing, or the policy is of another robot or size.
        OSError: the token cannot be read, or there is no server.
    """
    defaults = Settings((), "")
    named = ("execute", "patience", "picture_age", "state_age", "speed")
    own = {name: parameter(name, getattr(defaults, name)) for name in named}
    joints, sources = parameter("joints", list(PIPER)), parameter("cameras", ["side=side"])
    topics = dict(pair(text) for text in sources)
    token = parameter("token_file", "")
    token = File(token).read_text().strip() if token else ""
    server = Server(parameter("server", "ws://127.0.0.1:8000"), token, own["patience"], 300.0)
    told = server.metadata
    if missing := [name for name in told.get("cameras") or () if name not in topics]:
        raise ValueError(f"the policy needs the camera {missing[0]}: add '{missing[0]}=TOPIC'")
    robot = parameter("robot", "piper")
    if (other := told.get("robot") or robot) != robot:
        raise ValueError(f"the policy is of the robot {other}, not of {robot}: see parameter robot")
    if (size := told.get("action_dim") or len(joints)) != len(joints):
        raise ValueError(f"the policy's actions have {size} numbers, but there are {joints}")
    dt = parameter("control_dt", 0.0) or told.get("control_dt") or defaults.control_dt
    if not (prompt := parameter("prompt", "")):
        raise ValueError("the policy must be told what to do: set the parameter prompt")
    return server, topics, Settings(tuple(topics), prompt, joints, control_dt=dt, **own)
