"""A PiPER that follows targets one at a time, within the limits of `safety`; without LeRobot."""

import math

import numpy as np

from lorasp_jax.base.errors import describe_any
from lorasp_jax.extras.piper.arms import PERIOD, Arms
from lorasp_jax.extras.piper.clock import Clock
from lorasp_jax.extras.piper.interpolation import Path
from lorasp_jax.extras.piper.safety import Unsafe


class Follower:
    """Moves an arm to a target within a control step, as the simulator interpolates.

    After the last target, the arm holds it. After a problem, it brakes and holds for good: an arm
    that does not follow gives no demonstration.

    Attributes:
        problem: why the arm holds, in a sentence; None while it does not.
    """

    def __init__(self, arms: Arms, clock: Clock, control_dt: float) -> None:
        """Take an arm whose drivers are on; it stays where it is."""
        self._arms, self._clock, self._dt = arms, clock, control_dt
        self.problem: str | None = None
        self._stopped, start = False, arms.read()
        arms.start(start)
        self._way = Path(start, start[None], control_dt), clock.now()

    def pose(self) -> np.ndarray:
        """Return the measured pose [7]: joints [rad], gripper opening [m].

        Raises:
            Unsafe: the arm holds because of a problem.
        """
        if self.problem:
            raise Unsafe(self.problem)
        return self._arms.read()

    def follow(self, target: np.ndarray) -> np.ndarray:
        """Begin to move to a target [7]; return it as clipped to the limits.

        Raises:
            Unsafe: it is not finite, or the arm holds because of a problem.
        """
        if self.problem:
            raise Unsafe(self.problem)
        target = self._arms.clip(self._arms.check_chunk(target[None])[0])[None]
        now, (path, since) = self._clock.now(), self._way
        self._way = Path(path.target(now - since), target, self._dt), now
        return target[0]

    def run(self, seconds: float = math.inf) -> None:
        """Command the arm for some time, or until `stop`."""
        due = self._clock.now()
        end = due + seconds - PERIOD / 2
        try:
            while self._clock.now() < end and not self._stopped:
                self._tick()
                due = max(due, self._clock.now() - PERIOD) + PERIOD
                self._clock.wait_until(due)
        except BaseException as error:  # in a thread, nobody else would hear of it
            self.problem = describe_any(error)
            self.settle()
            raise

    def stop(self) -> None:
        """End `run`."""
        self._stopped = True

    def settle(self) -> None:
        """Brake; the arm then holds its last target."""
        self.problem = self.problem or "the arm was told to hold"
        while self._arms.moving:
            try:
                self._arms.read()
            except Exception as error:  # it brakes, whatever it can read
                self.problem = describe_any(error)
            self._arms.send(self._arms.brake())
            self._clock.wait_until(self._clock.now() + PERIOD)

    def _tick(self) -> None:
        self._arms.read()
        if not self.problem and (problem := self._arms.fault()):
            self._arms.yield_to_faults()
            self.problem = problem
        path, since = self._way
        now = self._clock.now()
        target = path.target(now + PERIOD - since)
        self._arms.send(self._arms.brake() if self.problem else self._arms.step(target))
