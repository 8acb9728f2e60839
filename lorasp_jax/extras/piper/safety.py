"""Limits and checks between a policy and a real PiPER, in plain NumPy.

A pose has seven numbers: the angles of joints 1 to 6 [rad], with the zeros of `family.Model`, and
the gripper's opening [m]. `Governor` turns targets into commands that keep all limits, and
brakes where it cannot. It stops by holding: an emergency stop makes a PiPER sink, and a reset drops
it, so both stay with a person.
"""

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from envs.robots.piper import ROBOT
from lorasp_jax.extras.piper.family import PIPER, Model

Zeros = Literal["sdk", "urdf"]
"""Where a firmware has the zeros of joints 2 and 3: as piper_sdk by default, or as the URDF."""
MAX_EFFORT = 1500
"""Highest gripper effort that we command [0.001 N m]; the firmware takes up to 5000. Our choice."""
MAX_AGE = 0.05
"""Age beyond which feedback is stale [s]: ten frames of a bus that sends at 200 Hz."""
MAX_DRIVER_AGE = 0.25
"""The same for the drivers' states [s]: ten frames at 40 Hz, which we infer from the 3040 frames
per second of a full bus (piper_sdk's issue 42), as 14 kinds come at 200 Hz."""
CAN_CONTROL = 1
"""Control mode in which the arm obeys the bus."""
_NEAR = np.deg2rad(5.0)  # rad; a target this close to the measured pose needs no slow approach
_APPROACH = 0.2  # share of the speed limit for slow approaches
_IMPLAUSIBLE = np.deg2rad(10.0)  # rad beyond the joint limits at which feedback is not believed
_ABSURD = np.append(np.full(6, _IMPLAUSIBLE), 0.02)  # beyond the limits [rad, m]; our choice
_CTRL_MODES = {0: "standby", 2: "teaching", 3: "ethernet", 4: "wifi", 5: "remote control"}
_CTRL_MODES |= {6: "leader of another arm", 7: "offline trajectory"}
_ARM_STATUS = {
    1: "emergency stop",
    2: "no solution",
    3: "singularity",
    4: "target beyond the joint limits",
    5: "a joint does not communicate",
    6: "a brake is closed",
    7: "collision",
    8: "too fast while guided by hand",
    9: "a joint has failed",
    10: "failure",
    11: "guided by hand",
    14: "controller too hot",
    15: "brake resistor too hot",
}


class Unsafe(ValueError):
    """Something that must not reach the arm; the message is one sentence."""


class Reading(NamedTuple):
    """What the arm reports.

    Attributes:
        pose: [7] measured joints [rad] and opening [m].
        age: of the oldest of the frames that the pose and the status came in [s].
        driver_age: of the oldest of the six drivers' states [s].
        ctrl_mode, arm_status: as in the frame 0x2A1.
        enabled: whether all six drivers are on.
    """

    pose: np.ndarray
    age: float
    driver_age: float
    ctrl_mode: int
    arm_status: int
    enabled: bool


@dataclass(frozen=True)
class Limits:
    """Limits of commands; poses are as in this module.

    Attributes:
        model: the arm.
        lower, upper: [7].
        speed, acceleration: [7], per s and per s².
        box_low, box_high: [3] corners of the space for the finger tips in the base frame [m].
    """

    model: Model
    lower: np.ndarray
    upper: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    box_low: np.ndarray
    box_high: np.ndarray

    @classmethod
    def of(
        cls,
        model: Model = PIPER,
        *,
        speed: float = 1.0,
        zeros: Zeros = "sdk",
        box_low: tuple[float, float, float] = (0.02, -0.45, 0.0),
        box_high: tuple[float, float, float] = (0.65, 0.45, 0.70),
    ) -> "Limits":
        """Return an arm's limits.

        Args:
            model: the arm.
            speed: highest joint speed [rad/s]; the arm's own limit is 3.
            zeros: the firmware's zeros; targets must be within its limits and the simulation's.
            box_low, box_high: as in the class. The mount stands on the table, z = 0. Our choice.

        Raises:
            ValueError: the speed or the box is out of range.
        """
        fastest = float(ROBOT.speed[0])
        if not 0 < speed <= fastest:
            raise ValueError(
                f"the speed must be above 0 and at most {fastest:g} rad/s, got {speed}"
            )
        if not all(low < high for low, high in zip(box_low, box_high, strict=True)):
            raise ValueError(f"the box must not be empty, got {box_low} to {box_high}")
        offset = model.offset if zeros == "sdk" else np.zeros(6)
        return cls(
            model=model,
            lower=np.append(np.maximum(model.lower, model.lower + offset), 0.0),
            upper=np.append(np.minimum(model.upper, model.upper + offset), ROBOT.stroke),
            speed=np.append(np.full(6, speed), ROBOT.gripper_speed),
            # The joints' is the firmware's default, 286.48 deg/s²; the gripper's is our choice.
            acceleration=np.append(np.full(6, 5.0), 2.0),
            box_low=np.array(box_low),
            box_high=np.array(box_high),
        )


def check_chunk(actions: Any, width: int = 7) -> np.ndarray:
    """Return a server's actions as float64 [C, width].

    Raises:
        Unsafe: they have another shape or kind, or a number is not finite.
    """
    chunk = np.asarray(actions)
    numbers = chunk.dtype.kind in "iuf" and chunk.ndim == 2 and len(chunk)
    if not numbers or chunk.shape[1] != width:
        got = f"{chunk.dtype} {list(chunk.shape)}"
        raise Unsafe(f"actions must be numbers [C, {width}], got {got}")
    if not np.isfinite(chunk).all():
        step = int(np.argwhere(~np.isfinite(chunk))[0, 0])
        raise Unsafe(f"actions must be finite, got {chunk[step]} at step {step}")
    return chunk.astype(float)


def clamped(chunk: np.ndarray, limits: Limits) -> str | None:
    """Say in a sentence that a chunk [C, 7] is clamped as a whole, by far; None: it is not."""
    beyond = np.maximum(limits.lower - chunk, chunk - limits.upper).min(axis=0)
    number = int((beyond - _ABSURD).argmax())
    if beyond[number] <= _ABSURD[number]:
        return None
    name = f"joint {number + 1}" if number < 6 else "the gripper"
    unit = "radians" if number < 6 else "meters"
    return (
        f"all actions of {name} are far beyond its limits, such as "
        f"{chunk[0, number]:.4g}, and clamped: are they in {unit}?"
    )


def fault(reading: Reading, limits: Limits) -> str | None:
    """Say in a sentence why an arm must not be commanded now; None: it may be."""
    joints = reading.pose[:6]
    if reading.age > MAX_AGE:
        return f"no feedback from the arm for {1000 * reading.age:.0f} ms"
    if reading.driver_age > MAX_DRIVER_AGE:
        return f"no state of a joint's driver for {1000 * reading.driver_age:.0f} ms"
    if not joints.any() or not np.isfinite(reading.pose).all():
        return "the arm reports no joint angles, only zeros: is it another arm's leader?"
    beyond = np.maximum(limits.lower[:6] - joints, joints - limits.upper[:6])
    if beyond.max() > _IMPLAUSIBLE:
        joint = int(beyond.argmax())
        degrees = np.rad2deg(joints[joint])
        return f"joint {joint + 1} reports {degrees:.0f} degrees, far beyond its limits"
    if reading.ctrl_mode != CAN_CONTROL:
        name = _CTRL_MODES.get(reading.ctrl_mode, "unknown")
        return f"the arm is in control mode {reading.ctrl_mode} ({name}), not {CAN_CONTROL}"
    if reading.arm_status:
        name = _ARM_STATUS.get(reading.arm_status, "unknown")
        return f"the arm reports status {reading.arm_status} ({name})"
    return None if reading.enabled else "a joint's driver is off"


def finger_tips(joints: np.ndarray, model: Model = PIPER) -> np.ndarray:
    """Return the point [3] between the ends of the fingers in the base frame [m]."""
    position, rotation = np.zeros(3), np.eye(3)
    for fixed, angle in zip(model.chain, joints, strict=True):
        position = position + rotation @ fixed[:3, 3]
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        rotation = rotation @ fixed[:3, :3] @ turn
    return position + model.tips * rotation[:, 2]


def outside(joints: np.ndarray, limits: Limits) -> float:
    """Return how far the finger tips are outside the box [m], 0 inside."""
    tips = finger_tips(joints, limits.model)
    return float(np.maximum(np.maximum(limits.box_low - tips, tips - limits.box_high), 0.0).max())


class Governor:
    """Turns targets into commands that keep the limits; one call per control tick.

    Attributes:
        pose: [7] the last command.
        velocity: [7] its speed [1/s].
        approaching: whether the arm is still on its slow way to the first target.
        blocked: whether the last step braked because the finger tips would leave the box.
    """

    def __init__(self, limits: Limits, dt: float) -> None:
        """Create one for ticks of `dt` seconds; call `start` before the first step."""
        self.limits, self._dt = limits, dt
        self.start(np.zeros(7))

    def start(self, pose: np.ndarray) -> None:
        """Begin at rest at a pose [7]; the first target is approached slowly."""
        self.pose, self.velocity = pose.astype(float), np.zeros(7)
        self.approaching, self.blocked = True, False
        self._target: np.ndarray | None = None

    def step(self, target: np.ndarray, *, slow: bool = False) -> np.ndarray:
        """Return the command [7] of this tick on the way to a target [7], as an approach if slow.

        Raises:
            Unsafe: the target has the wrong shape or is not finite.
        """
        target = np.clip(check_chunk(target[None])[0], self.limits.lower, self.limits.upper)
        if np.abs(target - self.pose)[:6].max() <= _NEAR:
            self.approaching = False
        speed = self.limits.speed * (_APPROACH if self.approaching or slow else 1.0)
        before = target if self._target is None or self.approaching else self._target
        self._target = target
        forward = np.clip((target - before) / self._dt, -speed, speed)
        wanted = forward + self._closing(before - self.pose)
        room_up, room_down = self.limits.upper - self.pose, self.limits.lower - self.pose
        wanted = np.clip(wanted, self._closing(room_down), self._closing(room_up))
        return self._move(np.clip(wanted, -speed, speed))

    def brake(self) -> np.ndarray:
        """Return the command [7] that slows down at the acceleration limit, then holds."""
        self._target, self.blocked = None, False
        self._advance(self._slower())
        return self.pose

    def _move(self, wanted: np.ndarray) -> np.ndarray:
        """Take a step unless the arm could then no longer stop inside the box."""
        change = self.limits.acceleration * self._dt
        velocity = np.clip(wanted, self.velocity - change, self.velocity + change)
        after = self.pose + velocity * self._dt
        stop = after + velocity * np.abs(velocity) / (2 * self.limits.acceleration)
        now = outside(self.pose[:6], self.limits)
        allowed = max(now, 1e-9)  # from outside, every step that leads back is allowed
        self.blocked = max(outside(x[:6], self.limits) for x in (after, stop)) > allowed
        if self.blocked:  # the gripper goes on
            velocity[:6] = self._slower()[:6]
        self._advance(velocity)
        return self.pose

    def _slower(self) -> np.ndarray:
        change = self.limits.acceleration * self._dt
        return np.sign(self.velocity) * np.maximum(np.abs(self.velocity) - change, 0.0)

    def _advance(self, velocity: np.ndarray) -> None:
        """Move; a start outside the joint limits may only lead back."""
        low = np.minimum(self.limits.lower, self.pose)
        high = np.maximum(self.limits.upper, self.pose)
        pose = np.clip(self.pose + velocity * self._dt, low, high)
        self.velocity, self.pose = (pose - self.pose) / self._dt, pose

    def _closing(self, distance: np.ndarray) -> np.ndarray:
        """Return the highest speed [7] from which the arm stops within a signed distance [7]."""
        step = self.limits.acceleration * self._dt  # change of speed per tick
        size = np.abs(distance)
        braking = step / 2 * (np.sqrt(1 + 8 * size / (step * self._dt)) - 1)
        return np.sign(distance) * np.minimum(braking, size / self._dt)
