"""Wrap an environment for Brax, to train from states (not images) with Brax's wrappers.

env = brax.envs.training.wrap(BraxEnv(envs.make("press")), episode_length=80)
state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 4096))

Brax's wrappers accept only keys from `jax.random.PRNGKey`, not from `jax.random.key`. The agents of
Brax 0.14.2 call `jax.device_put_replicated`, which JAX 0.10 removed (google/brax issue 671).
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs import base

from envs import checks
from envs.env import Env
from envs.scene.randomization import prepare
from envs.scene.ranges import Randomization
from envs.state import State
from lorasp_jax.base import fast_cpu

# Compile a single world: Brax adds its own batch axis, and nested batches would compile slower.
_reset = fast_cpu.jit(Env._reset, static_argnums=0)
_step = fast_cpu.jit(Env._step, static_argnums=0)
_full_state = fast_cpu.jit(Env._full_state, static_argnums=0)


class BraxEnv(base.Env):
    """One world of a task behind Brax's interface, for Brax's wrappers to batch and restart.

    Observations are those of `Env.full_state`, float32 `[D]`, without images. To render, call
    `observe` of the attribute `env` on `state.pipeline_state`, an `envs.State` of one world.

    Actions, `[A]` in [-1, 1], are rescaled to the range from `env.action_low` to `env.action_high`.
    The sparse reward is 1 once, on success. The dense reward needs `action_repeat=1`, since Brax
    sums the rewards of repeated actions without discounting.

    `done` means success or broken physics. Brax's EpisodeWrapper sets the episode length and marks
    episodes that reach it as truncated; the task's own limit is `env.max_steps`. Brax's
    AutoResetWrapper restarts a world in its initial state, with the same layout.

    Attributes:
        env: the wrapped environment, with one world.
        ranges: domain randomization.
    """

    def __init__(self, env: Env, *, ranges: Randomization | None = None):
        """Wrap an environment.

        Args:
            env: from `envs.make`; its number of worlds is ignored.
            ranges: domain randomization of every episode, as in `Env.reset`.

        Raises:
            ValueError: a range is invalid.
        """
        self.env: Env = dataclasses.replace(env, num_envs=1)
        prepare(ranges, env.control_dt)
        self.ranges = ranges

    def reset(self, rng: jax.Array) -> base.State:
        """Start one world; `rng` is the key for all randomness."""
        ranges = prepare(self.ranges, self.env.control_dt)
        with self.env._calls.first("reset", ranges is None):
            world = _reset(self.env, ranges, rng)
        return base.State(reward=world.reward, metrics=world.metrics, **self._fields(world))

    def step(self, state: base.State, action: jax.Array) -> base.State:
        """Simulate one control step.

        Args:
            state: one world.
            action: `[A]` in [-1, 1], clipped.

        Raises:
            ValueError: as in `Env.step`.
        """
        pipeline: Any = state.pipeline_state
        before = jax.tree.map(lambda x: x[0], pipeline)
        low, high = jnp.asarray(self.env.action_low), jnp.asarray(self.env.action_high)
        action = checks.action(action, low.shape)
        with self.env._calls.first("step", before.info["draw"] is None):
            world = _step(self.env, before, low + (action + 1) / 2 * (high - low))
        # Brax would treat the task's own time limit as a failure. Stop the clock so that the world
        # never reaches it.
        clock = jnp.zeros_like(world.info["steps"])
        world = dataclasses.replace(world, info=world.info | {"steps": clock})
        reward = jnp.where(before.done, 0.0, world.reward)
        metrics = state.metrics | world.metrics  # keep those that wrappers have added
        return state.replace(reward=reward, metrics=metrics, **self._fields(world))

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return jax.eval_shape(self.reset, jax.random.key(0)).obs.shape[0]

    @property
    def action_size(self) -> int:
        """Length A of an action."""
        return len(self.env.action_low)

    @property
    def backend(self) -> str:
        """The physics engine."""
        return "mjx"

    def _fields(self, world: State) -> dict[str, Any]:
        """Return fields of Brax's state; the leaves of `world` have no axis W."""
        return {
            "pipeline_state": jax.tree.map(lambda x: x[None], world),
            "obs": _full_state(self.env, world),
            "done": world.done.astype(jnp.float32),
        }
