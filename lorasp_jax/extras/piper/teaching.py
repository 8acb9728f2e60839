"""Record what a person shows the arm: by guiding it by hand, or with a second arm as the leader.

By hand, the PiPER is put into its teaching mode, in which the motors carry only its own weight.
With a leader, both arms are on the same bus and were set up once with piper_sdk's
`MasterSlaveConfig`: the leader sends targets, the follower obeys them, and both can be read.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np

from lorasp_jax.extras.piper.arms import Arms
from lorasp_jax.extras.piper.cameras import Look
from lorasp_jax.extras.piper.clock import Clock
from lorasp_jax.extras.piper.recording import Recording
from lorasp_jax.extras.piper.safety import CAN_CONTROL, Reading, Unsafe

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
        arms: Arms,
        look: Look,
        recorder: Recording,
        clock: Clock,
        *,
        way: Way,
        control_dt: float,
        corrects: bool = False,
    ) -> None:
        """Prepare a demonstration; for guiding by hand, the arms must be enabled.

        With `corrects`, a person goes on with a policy's episode, and its steps say so.
        """
        self._corrects = corrects
        self._arms, self._look, self._recorder = arms, look, recorder
        self._clock, self._way, self._dt = clock, way, control_dt
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
        if self.stopped:
            return
        try:
            if self._way == "hand":
                self._arms.teach(True)
            self._record(seconds, done)
        finally:
            if self._way == "hand":
                self._arms.teach(False)

    def _record(self, seconds: float, done: Callable[[], bool]) -> None:
        start = due = self._clock.now()
        before, shown, first = None, None, self._recorder.steps
        while self._clock.now() - start < seconds and not self.stopped and not done():
            pose = self._read()
            target = self._target(pose)
            if before is not None:
                shown = target if shown is None else shown
                if np.abs(target - shown).max() > _STILL or self._recorder.steps > first:
                    action = self._arms.clip(target)
                    self._recorder.step(*before, action, corrected=self._corrects)
            before = self._look(), pose
            due += self._dt
            self._clock.wait_until(due)

    def _target(self, pose: np.ndarray) -> np.ndarray:
        if self._way == "hand":
            return pose
        if (targets := self._arms.leaders()) is None:
            raise Unsafe("no leader sends targets on this bus")
        return targets

    def _read(self) -> np.ndarray:
        pose = self._arms.read(_taught)
        if problem := self._arms.fault():
            raise Unsafe(problem)
        return pose


def _taught(reading: Reading) -> Reading:
    """An arm that is guided need not be ready."""
    status = 0 if reading.arm_status == _TEACHING else reading.arm_status
    return reading._replace(ctrl_mode=CAN_CONTROL, enabled=True, arm_status=status)
