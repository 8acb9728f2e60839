"""The PiPER on its CAN bus, through the vendor's unmodified piper_sdk.

Order and units are those of the SDK's examples: connect, enable until all drivers report it, then
in every cycle mode, joints and gripper. The SDK logs bus errors and goes on, and one of its stamps
serves several frames, so the age of every kind of frame is measured here. MIT mode (0xAD), which
can damage the arm, is never used.
"""

import contextlib
import io
import warnings
from collections.abc import Iterable
from typing import Any

import numpy as np

from envs.robots.piper import ROBOT
from lorasp_jax.extras.piper.clock import Clock, RealClock
from lorasp_jax.extras.piper.family import PIPER, Model
from lorasp_jax.extras.piper.safety import (
    CAN_CONTROL,
    MAX_AGE,
    MAX_EFFORT,
    Limits,
    Reading,
    Unsafe,
    Zeros,
    fault,
)

_PER_DEGREE, _PER_METER = 1000.0, 1e6  # the bus counts 0.001 degrees and 0.001 mm
_MOVE_J = 0x01
_GRIPPER_ON = 0x01
_START_TEACHING, _STOP_TEACHING = 0x01, 0x02  # of the frame 0x150
_POSE_AND_STATUS = {
    0x2A1: "GetArmStatus",
    **dict.fromkeys((0x2A5, 0x2A6, 0x2A7), "GetArmJointMsgs"),
    0x2A8: "GetArmGripperMsgs",
}
_DRIVERS = dict.fromkeys(range(0x261, 0x267), "GetArmLowSpdInfoMsgs")
_LEADER = {
    **dict.fromkeys((0x155, 0x156, 0x157), "GetArmJointCtrl"),
    0x159: "GetArmGripperCtrl",
}
_GETTERS = _POSE_AND_STATUS | _DRIVERS | _LEADER  # what the SDK makes of each kind of frame
_POLL = 0.01  # s between two attempts to connect or enable
# Firmware limits have been found corrupted: all angles -0.1 degrees. Slower is still plausible.
_LEAST_RANGE, _LEAST_SPEED = 30.0, 0.1  # degrees, rad/s; our choices


class PiperArm:
    """One arm; not thread-safe.

    Attributes:
        sdk: the `C_PiperInterface_V2`.
        heard: when each kind of frame last came, by identifier [s].
    """

    def __init__(
        self,
        can: str = "can0",
        model: Model = PIPER,
        *,
        bus: str = "socketcan",
        speed: float = 1.0,
        effort: int = 1000,
        zeros: Zeros = "sdk",
        clock: Clock | None = None,
    ) -> None:
        """Open a bus; nothing is sent before `connect`.

        Args:
            can: name of the interface, such as can0.
            model: the arm.
            bus: python-can's name of its kind: socketcan, slcan or, for tests, virtual.
            speed: highest joint speed [rad/s]; the firmware gets the same as a share of 3 rad/s.
            effort: gripper effort [0.001 N m], at most `MAX_EFFORT`.
            zeros: the firmware's zeros.
            clock: measures the age of frames.

        Raises:
            ValueError: the effort is out of range.
            ConnectionError: there is no such interface, it is down or has another bitrate.
        """
        if not 0 < effort <= MAX_EFFORT:
            raise ValueError(f"the effort must be above 0 and at most {MAX_EFFORT}, got {effort}")
        self._effort, self._percent = effort, int(np.clip(np.ceil(speed / 3 * 100), 1, 100))
        self._offset = model.offset if zeros == "sdk" else np.zeros(6)
        self._clock = clock or RealClock()
        self.heard: dict[int, float] = {}
        self.sdk = _open(can, bus)
        self.sdk.GetCanBus().callback_function = self._hear

    def connect(self, timeout: float = 2.0) -> None:
        """Start reading, and wait for the first complete feedback.

        Raises:
            ConnectionError: no feedback comes.
            Unsafe: the firmware's own limits are corrupted.
        """
        self.sdk.ConnectPort()
        end = self._clock.now() + timeout
        while missing := [hex(x) for x in (*_POSE_AND_STATUS, *_DRIVERS) if x not in self.heard]:
            if self._clock.now() > end:
                raise ConnectionError(
                    f"the arm does not send {', '.join(missing)}: check its power, the cable and "
                    "the bitrate (1000000)"
                )
            self._clock.wait_until(self._clock.now() + _POLL / 2)
        self._check_firmware()

    def enable(self, limits: Limits, timeout: float = 5.0) -> None:
        """Switch the drivers on and take control at the measured pose.

        Args:
            limits: for a check of the feedback before the first command.
            timeout: time for the arm to comply [s].

        Raises:
            Unsafe: the feedback is implausible, or the arm reports a fault.
            ConnectionError: the drivers do not switch on, or the arm does not obey the bus.
        """
        # An earlier session's target may be in force: the drivers must not switch on with it.
        self.command(self._check_feedback(limits).pose)
        end = self._clock.now() + timeout
        while not self.sdk.EnablePiper():  # reports the state before the call
            self.command(self._check_feedback(limits).pose)
            self._wait(end, f"the drivers are not on after {timeout:g} s")
        while (reading := self._check_feedback(limits)).ctrl_mode != CAN_CONTROL:
            self.command(reading.pose)
            self._wait(end, f"the arm stays in control mode {reading.ctrl_mode}, not CAN control")

    def read(self) -> Reading:
        """Return the latest feedback."""
        opening = self.sdk.GetArmGripperMsgs().gripper_state.grippers_angle / _PER_METER
        angles = _angles(self.sdk.GetArmJointMsgs().joint_state)
        if angles.any():  # zeros mean that nothing has been received
            angles = angles + self._offset
        status = self.sdk.GetArmStatus().arm_status
        return Reading(
            pose=np.append(angles, opening),
            age=self._age(_POSE_AND_STATUS),
            driver_age=self._age(_DRIVERS),
            ctrl_mode=int(status.ctrl_mode),
            arm_status=int(status.arm_status),
            enabled=all(self.sdk.GetArmEnableStatus()),
        )

    def leader(self) -> np.ndarray | None:
        """Return the target [7] that another arm on the bus sends to this one; None: none does."""
        if self._age(_LEADER) > MAX_AGE:
            return None
        opening = self.sdk.GetArmGripperCtrl().gripper_ctrl.grippers_angle / _PER_METER
        return np.append(_angles(self.sdk.GetArmJointCtrl().joint_ctrl) + self._offset, opening)

    def command(self, pose: np.ndarray) -> None:
        """Send one target [7]; it stays in force until the next, as the arm has no watchdog.

        Raises:
            Unsafe: the target is not finite.
        """
        if not np.isfinite(pose).all():
            raise Unsafe(f"a target must be finite, got {pose}")
        counts = np.rint(np.rad2deg(pose[:6] - self._offset) * _PER_DEGREE).astype(int)
        self.sdk.MotionCtrl_2(CAN_CONTROL, _MOVE_J, self._percent, 0x00)
        self.sdk.JointCtrl(*counts.tolist())
        opening = max(0, round(pose[6] * _PER_METER))
        self.sdk.GripperCtrl(opening, self._effort, _GRIPPER_ON, 0)

    def teach(self, on: bool) -> None:
        """Enter or leave hand guiding, in which the motors only carry the arm's own weight."""
        self.sdk.MotionCtrl_1(0x00, 0x00, _START_TEACHING if on else _STOP_TEACHING)

    def disable(self) -> None:
        """Switch the drivers off: the arm falls unless it lies in its rest pose."""
        self.sdk.DisablePiper()

    def close(self) -> None:
        """Stop reading and close the bus; the arm holds its last target."""
        self.sdk.DisconnectPort()

    def _check_feedback(self, limits: Limits) -> Reading:
        reading = self.read()
        if problem := fault(reading._replace(enabled=True, ctrl_mode=CAN_CONTROL), limits):
            raise Unsafe(problem)
        return reading

    def _wait(self, end: float, problem: str) -> None:
        if self._clock.now() > end:
            raise ConnectionError(problem)
        self._clock.wait_until(self._clock.now() + _POLL)

    def _hear(self, message: Any) -> None:
        """Give the SDK a frame, and note the time unless it refuses it as implausible.

        Frames are stamped by the system's clock, which may jump, so we use our own. The SDK's
        `isOk` notices a silent bus only after 250 ms.
        """
        self.sdk.ParseCANFrame(message)
        getter = _GETTERS.get(message.arbitration_id)
        if getter and getattr(self.sdk, getter)().time_stamp == message.timestamp:
            self.heard[message.arbitration_id] = self._clock.now()

    def _age(self, kinds: Iterable[int]) -> float:
        """Return the age of the oldest of some kinds of frames [s]."""
        return self._clock.now() - min(self.heard.get(kind, -np.inf) for kind in kinds)

    def _check_firmware(self) -> None:
        """Refuse joint limits that no arm has; old firmware reports none."""
        motors = self.sdk.GetAllMotorAngleLimitMaxSpd().all_motor_angle_limit_max_spd.motor[1:]
        for number, motor in enumerate(motors, start=1):
            span, speed = (motor.max_angle_limit - motor.min_angle_limit) / 10, motor.max_joint_spd
            reported = motor.max_angle_limit or motor.min_angle_limit or speed
            if reported and (span < _LEAST_RANGE or speed / 1000 < _LEAST_SPEED):
                raise Unsafe(
                    f"the firmware's limits of joint {number} are corrupted (a range of {span:g} "
                    f"degrees, {speed / 1000:g} rad/s): set them with piper_sdk first"
                )


class NoArm:
    """What a dry run needs of an arm, without a bus: it stands in its start pose."""

    def __init__(self, model: Model = PIPER) -> None:
        """Stand still."""
        self._pose = np.append(model.home, ROBOT.stroke)

    def connect(self) -> None:
        """Do nothing."""

    def read(self) -> Reading:
        """Return the start pose."""
        return Reading(self._pose, 0.0, 0.0, CAN_CONTROL, 0, True)

    def command(self, pose: np.ndarray) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


def _angles(joints: Any) -> np.ndarray:
    """Convert the SDK's joint counts to angles [6] in rad."""
    counts = [getattr(joints, f"joint_{i + 1}") for i in range(6)]
    return np.deg2rad(np.array(counts) / _PER_DEGREE)


def _open(can: str, bus: str) -> Any:
    from piper_sdk import C_PiperInterface_V2, LogLevel
    from piper_sdk.hardware_port import can_encapsulation

    checked = bus == "socketcan"
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the SDK's use of python-can
        try:
            # Errors that it logs are either raised or seen as stale feedback.
            options = {"can_auto_init": False, "logger_level": LogLevel.CRITICAL}
            sdk = C_PiperInterface_V2(can, judge_flag=False, **options)
            # It prints each frame that it cannot send, and a stalled terminal would stall the arm.
            can_encapsulation.print = lambda *_: None  # type: ignore[attr-defined]
            sdk.CreateCanBus(can, bustype=bus, judge_flag=checked)
        except ConnectionError as error:
            raise ConnectionError(
                f"cannot open {can}: connect the adapter, then bring the interface up with "
                f"'can_activate.sh {can} 1000000' of piper_sdk"
            ) from error
    return sdk
