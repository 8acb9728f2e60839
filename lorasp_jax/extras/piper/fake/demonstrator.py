"""The scripted expert as a policy, to test everything between a policy and the arm."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs.experts import expert
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
        self.actions: np.ndarray = np.asarray(
            _actions(world.env, world.state, jax.random.key(seed))
        )

    def __call__(self, observation: Observation) -> np.ndarray:  # noqa: ARG002
        """Return actions [C, 7], counted from the first question."""
        now = self._clock.now()
        self._start = now if self._start is None else self._start
        first = round((now - self._start) / self._dt)
        return self.actions[np.minimum(first + np.arange(_CHUNK), len(self.actions) - 1)]


@functools.partial(jax.jit, static_argnums=0)
def _actions(env: envs.Env, state: envs.State, key: jax.Array) -> jax.Array:
    """Return the expert's actions [T, 7] from a state of one world."""
    plan = expert.plan(env, state, key)

    def act(step: jax.Array) -> jax.Array:
        at_step = dataclasses.replace(state, info=state.info | {"steps": step[None]})
        return expert.act(env, plan, at_step)[0]

    return jax.vmap(act)(jnp.arange(env.expert_steps))
