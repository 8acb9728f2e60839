"""One arm, or several that move, brake and hold as one.

Poses of N arms are joined in order: [7 N] joints [rad] and openings [m], as a two-armed policy and
LeRobot's two-armed datasets have them, the left arm first. Each arm keeps its own limits, and a
fault of one is a fault of all.
"""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from lorasp_jax.extras.piper.arm import NoArm, PiperArm
from lorasp_jax.extras.piper.safety import (
    CAN_CONTROL,
    MAX_AGE,
    Governor,
    Limits,
    Reading,
    check_chunk,
    clamped,
    fault,
)

PERIOD = 0.005
"""Time between two commands [s], as in piper_sdk's examples (200 Hz)."""
SIDES = ("left", "right")
"""Names of two arms, in their order."""
JOINTS = (*(f"joint_{i + 1}" for i in range(6)), "gripper")
"""Names of the numbers of a pose."""


class Arms:
    """Arms of one model and with the same limits, each in its own base frame.

    Attributes:
        limits: of each.
        measured: [7 N] the poses that were read last.
    """

    def __init__(self, arms: Mapping[str, PiperArm | NoArm], limits: Limits) -> None:
        """Join name -> arm; the name of a single arm is ""."""
        self._arms, self.limits = [*arms.values()], limits
        self._prefixes = [f"{name} arm: " if name else "" for name in arms]
        self._governors = [Governor(limits, PERIOD) for _ in arms]
        self._yielded: set[int] = set()
        self._latest: dict[int, Reading] = {}

    def connect(self) -> None:
        """Start reading all; raise what `PiperArm.connect` does, with the arm's name."""
        self._in_turn(lambda index: self._arms[index].connect())

    def enable(self) -> None:
        """Switch all on; raise what `PiperArm.enable` does, with the arm's name."""
        on = f"; the {SIDES[0]} arm is on, and holds"
        self._in_turn(lambda index: self._arms[index].enable(self.limits), after_first=on)

    def teach(self, on: bool) -> None:
        """Enter or leave hand guiding."""
        self._each(lambda index: self._arms[index].teach(on))

    def close(self) -> None:
        """Close all buses; the arms hold their last targets."""
        self._each(lambda index: self._arms[index].close())

    def read(self, seen_as: Callable[[Reading], Reading] = lambda reading: reading) -> np.ndarray:
        """Read all, as a function sees it, and return `measured`."""

        def read(index: int) -> None:
            self._latest[index] = seen_as(self._arms[index].read())

        self._each(read)
        self.measured = np.concatenate([reading.pose for reading in self.readings])
        return self.measured

    def leaders(self) -> np.ndarray | None:
        """Return the targets [7 N] that other arms send to these; None: one is missing."""
        targets = [arm.leader() for arm in self._arms]
        found = [target for target in targets if target is not None]
        return np.concatenate(found) if len(found) == len(targets) else None

    @property
    def readings(self) -> list[Reading]:
        """What each arm reported last."""
        return [self._latest[index] for index in range(len(self._arms))]

    @property
    def rest(self) -> np.ndarray:
        """Pose [7 N] in which the arms lie folded."""
        return np.tile(self.limits.model.rest, len(self._arms))

    @property
    def pose(self) -> np.ndarray:
        """The last commands [7 N]."""
        return np.concatenate([governor.pose for governor in self._governors])

    @property
    def moving(self) -> bool:
        """Whether a command still has some speed."""
        return any(governor.velocity.any() for governor in self._governors)

    @property
    def approaching(self) -> bool:
        """Whether an arm is still on its slow way to the first target."""
        return any(governor.approaching for governor in self._governors)

    @property
    def taken(self) -> bool:
        """Whether an arm reports a fault, or obeys somebody else: none may go on by itself."""
        return any(bool(r.arm_status) or r.ctrl_mode != CAN_CONTROL for r in self.readings)

    def fault(self) -> str | None:
        """Say in a sentence why the arms must not be commanded now; None: they may be."""
        return self._first([fault(reading, self.limits) for reading in self.readings])

    def check_chunk(self, actions: Any) -> np.ndarray:
        """Return actions as float64 [C, 7 N]; raise `Unsafe` if they are not."""
        return check_chunk(actions, 7 * len(self._arms))

    def clamped(self, chunk: np.ndarray) -> str | None:
        """Say in a sentence that an arm's part of a chunk is clamped as a whole, by far."""
        words = self._first([clamped(part, self.limits) for part in self._split(chunk)])
        return words and f"warning: {words}"

    def clip(self, pose: np.ndarray) -> np.ndarray:
        """Return a pose [7 N] within the limits of joints and grippers."""
        low, high = self.limits.lower, self.limits.upper
        return np.concatenate([np.clip(part, low, high) for part in self._split(pose)])

    def distance(self, pose: np.ndarray) -> float:
        """Return how far the joint that is farthest from a pose [7 N] is from it [rad]."""
        return float(np.abs(self.pose - pose).reshape(-1, 7)[:, :6].max())

    def start(self, pose: np.ndarray) -> None:
        """Begin at rest at a pose [7 N]; the first target is approached slowly."""
        self._yielded.clear()
        for governor, part in zip(self._governors, self._split(pose), strict=True):
            governor.start(part)

    def yield_to_faults(self) -> None:
        """Let arms that may stand still already, for a fault of their own, hold where they are."""
        for index, reading in enumerate(self.readings):
            stands = reading.age <= MAX_AGE and (reading.arm_status or not reading.enabled)
            if stands and (index not in self._yielded or not reading.enabled):  # it may sink
                self._governors[index].start(reading.pose)
                self._yielded.add(index)

    def step(self, target: np.ndarray, *, slow: bool = False) -> np.ndarray:
        """Return the commands [7 N] of this tick on the way to a target [7 N].

        While the box blocks one arm, the others brake: they may carry the same thing.
        """
        blocked = any(governor.blocked for governor in self._governors)

        def step(governor: Governor, part: np.ndarray) -> np.ndarray:
            if blocked and not governor.blocked:
                return governor.brake()
            return governor.step(part, slow=slow)

        return np.concatenate([*map(step, self._governors, self._split(target))])

    def brake(self) -> np.ndarray:
        """Return the commands [7 N] that slow all down at the acceleration limit, then hold."""
        return np.concatenate([governor.brake() for governor in self._governors])

    def send(self, command: np.ndarray) -> None:
        """Command [7 N] the arms that obey the bus; others are a person's or a program's."""

        def send(index: int) -> None:
            if self.readings[index].ctrl_mode == CAN_CONTROL:
                self._arms[index].command(parts[index])

        parts = self._split(command)
        self._each(send)

    def describe(self, command: np.ndarray) -> str:
        """Return a command [7 N] in words."""
        words = []
        for prefix, part in zip(self._prefixes, self._split(command), strict=True):
            degrees = " ".join(f"{angle:7.2f}" for angle in np.rad2deg(part[:6]))
            words.append(f"{prefix}{degrees} degrees, {1000 * part[6]:.1f} mm")
        return "; ".join(words)

    def _first(self, found: Sequence[str | None]) -> str | None:
        """Return the first words that are found of an arm, after its name."""
        named = zip(self._prefixes, found, strict=True)
        return next((f"{prefix}{words}" for prefix, words in named if words), None)

    def _split(self, joined: np.ndarray) -> list[np.ndarray]:
        return np.split(joined, len(self._arms), axis=-1)

    def _each(self, act: Callable[[int], None]) -> None:
        """Act on every arm, also after one has failed; what it raised comes then."""
        with contextlib.ExitStack() as stack:
            for index in reversed(range(len(self._arms))):
                stack.callback(act, index)

    def _in_turn(self, act: Callable[[int], None], after_first: str = "") -> None:
        """Act on one arm after the other, and let errors name the arm."""
        for index, prefix in enumerate(self._prefixes):
            try:
                act(index)
            except (ConnectionError, ValueError) as error:
                raise type(error)(f"{prefix}{error}{after_first * bool(index)}") from error


def dimension_names(sides: Sequence[str]) -> list[str]:
    """Return the names of the dimensions of a pose, as LeRobot has them: left_joint_1.pos."""
    return [f"{side}_{name}.pos".lstrip("_") for side in sides for name in JOINTS]
