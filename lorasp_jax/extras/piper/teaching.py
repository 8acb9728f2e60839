"""Record what a person shows the arm: by guiding it by hand, or with a second arm as the leader.

By hand, the PiPER is put into its teaching mode, in which the motors carry only its own weight.
With a leader, both arms are on the same bus and were set up once with piper_sdk's
`MasterSlaveConfig`: the leader sends targets, the follower obeys them, and both can be read.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np

from lorasp_jax.extras.piper.arm import PiperArm
from lorasp_jax.extras.piper.cameras import Look
from lorasp_jax.extras.piper.clock import Clock
from lorasp_jax.extras.piper.recording import Recording
from lorasp_jax.extras.piper.safety import CAN_CONTROL, Limits, Reading, Unsafe, fault

Way = Literal["hand", "leader"]
_TEACHING = 11  # arm_status in teaching mode
_STILL = 0.002  # rad or m; a pose this close to the last has not moved


class Lesson:
    """One demonstration.

    Attributes:
        stopped: whether `stop` was called.
    """

    def __init__(
        self,
        arm: PiperArm,
        look: Look,
        recorder: Recording,
        limits: Limits,
        clock: Clock,
        *,
        way: Way,
        control_dt: float,
    ) -> None:
        """Prepare a demonstration; for guiding by hand, the arm must be enabled."""
        self._arm, self._look, self._recorder = arm, look, recorder
        self._limits, self._clock, self._way, self._dt = limits, clock, way, control_dt
        self.stopped = False

    def stop(self) -> None:
        """End the demonstration; may be called from a signal handler."""
        self.stopped = True

    def run(self, seconds: float, done: Callable[[], bool] = lambda: False) -> None:
        """Record until the time is over, `stop` is called or `done` says so.

        A step's action is where the arm was, or was told to go, one control step later. Steps
        before the first movement are left out.

        Raises:
            Unsafe: feedback stops or is implausible, the arm reports a fault, there is no leader,
                or a picture is missing.
        """
        if self._way == "hand":
            self._arm.teach(True)
        try:
            self._record(seconds, done)
        finally:
            if self._way == "hand":
                self._arm.teach(False)

    def _record(self, seconds: float, done: Callable[[], bool]) -> None:
        start = due = self._clock.now()
        before = shown = None
        while self._clock.now() - start < seconds and not self.stopped and not done():
            reading = self._read()
            target = self._target(reading)
            if before is not None:
                shown = target if shown is None else shown
                if np.abs(target - shown).max() > _STILL or self._recorder.steps:
                    self._recorder.step(
                        *before, np.clip(target, self._limits.lower, self._limits.upper)
                    )
            before = self._look(), reading.pose
            due += self._dt
            self._clock.wait_until(due)

    def _target(self, reading: Reading) -> np.ndarray:
        if self._way == "hand":
            return reading.pose
        if (leader := self._arm.leader()) is None:
            raise Unsafe("no leader sends targets on this bus")
        return leader

    def _read(self) -> Reading:
        reading = self._arm.read()
        seen = reading._replace(ctrl_mode=CAN_CONTROL, enabled=True)
        if seen.arm_status == _TEACHING:
            seen = seen._replace(arm_status=0)
        if problem := fault(seen, self._limits):
            raise Unsafe(problem)
        return reading
