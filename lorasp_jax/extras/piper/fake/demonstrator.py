"""The scripted expert as a policy, to test everything between a policy and the arm."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from envs.experts import expert
from envs.state import State
from lorasp_jax.extras.piper.asking import Observation
from lorasp_jax.extras.piper.clock import Clock
from lorasp_jax.extras.piper.fake.world import World

_CHUNK = 20  # actions per answer; our choice


class Demonstrator:
    """Answers with the expert's actions from now on."""

    def __init__(self, world: World, clock: Clock, seed: int) -> None:
        """Plan for the world's present layout."""
        self._clock, self._start = clock, None
        self._dt = world.env.control_dt
        self.actions = _actions(world, jax.random.key(seed))

    def __call__(self, observation: Observation) -> np.ndarray:  # noqa: ARG002
        """Return actions [C, 7], counted from the first question."""
        now = self._clock.now()
        self._start = now if self._start is None else self._start
        first = round((now - self._start) / self._dt)
        return self.actions[np.minimum(first + np.arange(_CHUNK), len(self.actions) - 1)]


def _actions(world: World, key: jax.Array) -> np.ndarray:
    """Return the expert's actions [T, 7] for the world's layout."""
    env = world.env
    plan = expert.plan(env, world.state, key)

    def act(state: State, step: jax.Array) -> jax.Array:
        at_step = dataclasses.replace(state, info=state.info | {"steps": step[None]})
        return expert.act(env, plan, at_step)[0]

    steps = jnp.arange(env.expert_steps)
    return np.asarray(jax.jit(jax.vmap(act, in_axes=(None, 0)))(world.state, steps))
