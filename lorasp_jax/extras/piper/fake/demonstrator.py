"""The scripted expert as a policy, to test everything between a policy and the arm."""

import numpy as np

from lorasp_jax.extras.piper.asking import Observation
from lorasp_jax.extras.piper.clock import Clock
from lorasp_jax.extras.piper.fake.world import World

_CHUNK = 20  # actions per answer; our choice


class Demonstrator:
    """Answers with the expert's actions from now on."""

    def __init__(self, world: World, clock: Clock, seed: int) -> None:
        """Plan for the world's present layout."""
        self._clock, self._start, self._dt = clock, None, world.control_dt
        self.actions = world.demonstration(seed)

    def __call__(self, observation: Observation) -> np.ndarray:  # noqa: ARG002
        """Return actions [C, 7 N] for N arms, counted from the first question."""
        now = self._clock.now()
        self._start = now if self._start is None else self._start
        first = round((now - self._start) / self._dt)
        return self.actions[np.minimum(first + np.arange(_CHUNK), len(self.actions) - 1)]
