"""The fake arm's controller: CAN frames in, servo targets out, feedback at 200 Hz.

It imitates what matters to a client: drivers that must be switched on, control modes, the speed
percentage, the last target that stays in force, delays and noise; and that the arm sinks after an
emergency stop, and falls after a reset or without its drivers.
"""

from collections import deque
from typing import Any

import can
import numpy as np

from envs.robots.piper import ROBOT, SDK_OFFSET
from lorasp_jax.extras.piper.fake import frames
from lorasp_jax.extras.piper.fake.world import Limb, World

PERIOD = 0.005
"""Time between two feedback frames of a kind [s], as measured on PiPERs (200 Hz)."""
_SLOW = 10  # the drivers' own states come every tenth time
_FASTEST, _GRIPPER_SPEED = 3.0, 0.1  # rad/s as the firmware's default; m/s, our choice
_STANDBY, _CAN, _TEACHING = 0, 1, 2
_MIT = 0xAD
_EMERGENCY, _GUIDED = 1, 11  # arm_status
_STOP, _RESUME = 1, 2  # of the frame 0x150


class FakePiper:
    """A PiPER on one end of a virtual bus.

    Attributes:
        world, limb: the simulated scene, and the arm in it.
        time: simulated time [s].
        stamp: time stamp of the latest frames [s].
        reported: when the latest feedback was sent [s].
        commands: number of joint targets received.
        hand: pose [7] to which a person guides the arm while it is in teaching mode.
        unsafe: everything received that a client must never send, in words.
    """

    def __init__(
        self,
        channel: str,
        world: World,
        limb: Limb | World | None = None,
        *,
        latency: float = 0.0,
        noise: float = 2e-4,
        seed: int = 0,
    ) -> None:
        """Join a bus.

        Args:
            channel: name of python-can's virtual bus.
            world: the scene; call its `reset` first.
            limb: the arm in it; None: its only one.
            latency: delay of every command [s].
            noise: standard deviation of measured angles [rad]; our choice.
            seed: of the noise.
        """
        self.world, self.limb = world, limb or world
        self.time, self.stamp, self.reported = 1.0, 1.0, 0.0
        self.unsafe: list[str] = []
        self.commands, self.hand = 0, None
        self._latency, self._noise = latency, noise
        self._random = np.random.default_rng(seed)
        self._bus = can.Bus(channel, interface="virtual", preserve_timestamps=True)
        self._waiting: deque[tuple[float, Any]] = deque()
        self._tick, self._ctrl_mode, self._stopped = 0, _STANDBY, 0
        self._percent, self._enabled = 100, np.zeros(6, bool)
        self._target, self._setpoint = self.limb.pose, self.limb.pose

    def start(self) -> None:
        """Stand where the arm is, and lose commands that are still on their way."""
        self._receive()
        self._waiting.clear()
        self._target, self._setpoint = self.limb.pose, self.limb.pose

    def obey(self) -> None:
        """Begin a tick: receive, and move the servos' targets."""
        self.time = self.stamp = round(self.time + PERIOD, 6)
        self._receive()
        while self._waiting and self._waiting[0][0] <= self.time + 1e-9:
            self._obey(self._waiting.popleft()[1])
        self._move()

    def report(self) -> None:
        """End a tick: send feedback."""
        self._tick += 1
        self._report()

    def _receive(self) -> None:
        while (message := self._bus.recv(0)) is not None:
            self._waiting.append((self.time + self._latency, message))

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()

    def _obey(self, message: can.Message) -> None:
        kind, data = message.arbitration_id, bytes(message.data)
        if kind in frames.TARGETS:
            first = 2 * frames.TARGETS.index(kind)
            pair = np.deg2rad(np.array(frames.unpack_pair(data)) / 1000)
            self._aim(slice(first, first + 2), pair + SDK_OFFSET[first : first + 2])
            self.commands += kind == frames.TARGETS[-1]
        elif kind == frames.GRIPPER_TARGET:
            opening, effort, code = frames.unpack_gripper(data)
            self._check(0 <= opening <= 70000, f"gripper {opening / 1000} mm")
            self._check(effort <= 5000 and code in (0, 1), f"effort {effort}, code {code}")
            self._target[6] = np.clip(opening / 1e6, 0, ROBOT.stroke)
        elif kind == frames.MODE:
            self._check(data[3] != _MIT, "MIT mode")
            self._check(1 <= data[2] <= 100, f"speed {data[2]} %")
            if self._ctrl_mode != _TEACHING:  # a person has the arm until teaching ends
                self._ctrl_mode = data[0]
            self._percent = data[2]
        elif kind == frames.ENABLE:
            self._switch(data[1] == 0x02)
        elif kind == frames.STOP_OR_TEACH:
            self._stop_or_teach(data)
        elif kind == frames.ASK_LIMITS and data[1] == 0x01:
            self._tell_limits(data[0])

    def _switch(self, on: bool) -> None:
        """Switch the drivers: without them the arm falls, and with them it stays where it is."""
        if self._enabled.any() and not on:
            self.limb.support("none")
        elif on and not self._enabled.all():
            self.limb.support("none" if self._stopped else "motors")
            self._target, self._setpoint = self.limb.pose, self.limb.pose
        self._enabled[:] = on

    def _stop_or_teach(self, data: bytes) -> None:
        if data[0]:
            self.unsafe.append("emergency stop or reset")
        if data[0] == _STOP:
            self._stopped = _EMERGENCY
            self.limb.support("damping")  # it sinks
        elif data[0] == _RESUME:  # which cuts the power at once
            self._stopped, self._ctrl_mode = 0, _STANDBY
            self._switch(False)
        if data[2] in (1, 2):
            self._ctrl_mode = _TEACHING if data[2] == 1 else _STANDBY
            self._target = self.limb.pose

    def _aim(self, joints: slice, angles: np.ndarray) -> None:
        # A count is 0.001 degrees, and a target at a limit may be rounded past it.
        low, high = ROBOT.lower[joints] - 2e-5, ROBOT.upper[joints] + 2e-5
        if not np.all((low <= angles) & (angles <= high)):
            degrees = np.rad2deg(angles)
            self.unsafe.append(f"joints {joints.start + 1}-{joints.stop} at {degrees} deg")
        elif self._ctrl_mode == _CAN:
            self._target[joints] = angles

    def _check(self, fine: bool, what: str) -> None:
        if not fine:
            self.unsafe.append(what)

    def _move(self) -> None:
        """Let the servos' targets follow the last target, as fast as the percentage allows."""
        if self._ctrl_mode == _TEACHING:
            self._setpoint = self.limb.pose if self.hand is None else np.array(self.hand)
        elif self._enabled.all() and not self._stopped:
            speed = np.append(np.full(6, _FASTEST * self._percent / 100), _GRIPPER_SPEED) * PERIOD
            self._setpoint = self._setpoint + np.clip(self._target - self._setpoint, -speed, speed)
        self.limb.command(self._setpoint)

    def _report(self) -> None:
        pose = self.limb.pose
        angles = pose[:6] + self._noise * self._random.standard_normal(6) - SDK_OFFSET
        counts = np.rad2deg(angles) * 1000
        for i, kind in enumerate(frames.JOINTS):
            self._send(kind, frames.pair(*counts[2 * i : 2 * i + 2]))
        self._send(frames.GRIPPER, frames.gripper(1e6 * pose[6], 0, bool(self._enabled.all())))
        if self._tick % _SLOW == 0:
            for i, kind in enumerate(frames.DRIVERS):
                self._send(kind, frames.driver(bool(self._enabled[i])))
        teaching = int(self._ctrl_mode == _TEACHING)
        status = self._stopped or (_GUIDED if teaching else 0)
        self._send(frames.STATUS, frames.status(self._ctrl_mode, status, teaching))
        self.reported = self.time

    def _tell_limits(self, joint: int) -> None:
        low, high = np.rad2deg([ROBOT.lower[joint - 1], ROBOT.upper[joint - 1]])
        self._send(frames.FIRMWARE_LIMITS, frames.firmware_limits(joint, low, high, _FASTEST))

    def _send(self, kind: int, data: bytes) -> None:
        message = can.Message(arbitration_id=kind, data=data, is_extended_id=False)
        message.timestamp = self.stamp
        self._bus.send(message)
