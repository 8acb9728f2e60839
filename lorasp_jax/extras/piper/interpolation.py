"""From a chunk of actions at the policy's rate to targets at the arm's rate."""

import math

import numpy as np


class Path:
    """Straight lines through a chunk of actions, as the simulator interpolates them.

    During control step i, the target moves from action i - 1 to action i and arrives at the end.
    See `envs.actions.interpolate`.

    Attributes:
        steps: number of control steps until the path ends.
    """

    def __init__(self, start: np.ndarray, actions: np.ndarray, control_dt: float) -> None:
        """Create a path.

        Args:
            start: [7 N] target before the first action.
            actions: [C, 7 N], one per control step.
            control_dt: duration of a control step [s].
        """
        self._knots, self._dt = np.concatenate([start[None], actions]), control_dt
        self.steps = len(actions)

    def starting_at(self, start: np.ndarray) -> "Path":
        """Return this path from another start [7 N]."""
        return Path(start, self._knots[1:], self._dt)

    def switching(self, observed: int, step: int, actions: np.ndarray) -> "Path":
        """Return the path that follows this one up to a step, and then a new chunk.

        Args:
            observed: this path's step at which the new chunk was asked for; the returned path, and
                the new chunk, count from there.
            step: this path's step from which on the new chunk is followed.
            actions: [C, 7 N] the new chunk.
        """
        under_way = self._knots[observed + 1 : step + 1]
        actions = np.concatenate([under_way, actions[step - observed :]])
        return Path(self._knots[observed], actions, self._dt)

    def action(self, step: int) -> np.ndarray:
        """Return the action of a control step from 0, [7 N]."""
        return self._knots[step + 1]

    def target(self, seconds: float) -> np.ndarray:
        """Return the target [7 N] at a time since the start [s]; past the end, the last action."""
        position = min(max(seconds / self._dt, 0.0), float(self.steps))
        step = min(math.floor(position), self.steps - 1)
        fraction = position - step
        return self._knots[step] + fraction * (self._knots[step + 1] - self._knots[step])
