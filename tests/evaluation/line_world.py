"""An environment of another package's kind, a point on a line with pictures, and its tasks.

Processes of the judge import this module, so it imports little.
"""

import dataclasses
from typing import ClassVar

import gymnasium
import numpy as np

from lorasp_jax.extras.judge import GymTask


class Line(gymnasium.Env):
    """A point at distance 1 to 2 from the goal, on either side; one step moves it by 0.1."""

    metadata: ClassVar = {"render_fps": 20}
    action_space = gymnasium.spaces.Box(-1, 1, (1,))

    def __init__(self, key="success"):
        self._key = key

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = self.np_random.uniform(1, 2) * self.np_random.choice([-1, 1])
        return self._observe(), {}

    def step(self, action):
        self.at += 0.1 * float(np.clip(action, -1, 1)[0])
        return self._observe(), 0.0, False, abs(self.at) > 3, {self._key: abs(self.at) < 0.06}

    def _observe(self):
        return {"pixels": np.full((8, 8, 3), 100, np.uint8), "at": np.array([self.at])}


TASK = GymTask("line", "go to zero", Line, {"front": "pixels"}, "at", replan=2, max_steps=40)


def tasks():
    """Return what a user's factory returns."""
    return [TASK, dataclasses.replace(TASK, name="other", group="easy")]


def not_tasks():
    return 3
