"""An environment as a Brax environment, for training from states with Brax's wrappers.

env = brax.envs.training.wrap(BraxEnv(envs.make("press")), episode_length=80)
state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 4096))

Brax's wrappers take keys of `jax.random.PRNGKey` only, not of `jax.random.key`. The agents in Brax
0.14.2 call `jax.device_put_replicated`, which JAX 0.10 has removed (google/brax issue 671).
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from envs import checks
from envs.compilation import fast_cpu
from envs.env import Env
from envs.scene.randomization import Randomization, prepared
from envs.state import State

try:
    from brax.envs import base
except ImportError as error:
    raise ImportError('envs.interop.brax needs Brax: pip install -e ".[brax]"') from error

# One world alone: what Brax batches anew would else be traced, and compiled, as a batch of batches.
_reset = fast_cpu.jit(Env._reset, static_argnums=0)
_step = fast_cpu.jit(Env._step, static_argnums=0)
_full_state = fast_cpu.jit(Env._full_state, static_argnums=0)


class BraxEnv(base.Env):
    """One world of a task behind Brax's interface; Brax's wrappers batch, time and restart it.

    Observations are those of `Env.full_state`, float32 [D]. There are no pictures in them:
    `state.pipeline_state` is the `envs.State` of one world, from which `env.observe` makes them.

    Actions, [A] in [-1, 1], span `action_low` to `action_high` of the environment inside. The
    sparse reward is 1 once, when the task is done, so the return of an episode is its success; the
    dense one wants `action_repeat=1`, for a wrapper that repeats actions adds rewards without
    discount. `done` means success or broken physics. Time is left to Brax: an episode lasts as long
    as the wrapper says (`env.max_steps` is the task's own limit), and its end is a truncation.
    Brax's AutoResetWrapper restarts a world as it first was, the layout included.

    Attributes:
        env: the environment inside, of one world.
        ranges: how worlds differ.
    """

    def __init__(self, env: Env, *, ranges: Randomization | None = None):
        """Wrap an environment.

        Args:
            env: what `envs.make` gave; its number of worlds does not matter.
            ranges: as for `Env.reset`, for every episode.

        Raises:
            TypeError: if it is no environment.
            ValueError: if the ranges make no sense.
        """
        checks.instance("env", env, Env, "what envs.make gave")
        self.env = dataclasses.replace(env, num_envs=1)
        prepared(ranges, env.control_dt)
        self.ranges = ranges

    def reset(self, rng: jax.Array) -> base.State:
        """One fresh world, all from the key `rng`.

        Raises:
            TypeError: if it is no key.
        """
        ranges = prepared(self.ranges, self.env.control_dt)
        with self.env._calls.first("reset", ranges is None):
            world = _reset(self.env, ranges, checks.key(rng))
        return base.State(reward=world.reward, metrics=world.metrics, **self._seen(world))

    def step(self, state: base.State, action: jax.Array) -> base.State:
        """The world one control step later.

        Args:
            state: one world.
            action: [A] in [-1, 1]; clipped.

        Raises:
            TypeError, ValueError: as `Env.step`.
        """
        pipeline: Any = state.pipeline_state
        checks.instance("state.pipeline_state", pipeline, State, "what reset gave")
        before = jax.tree.map(lambda x: x[0], pipeline)
        low, high = jnp.asarray(self.env.action_low), jnp.asarray(self.env.action_high)
        action = checks.action(action, low.shape)
        with self.env._calls.first("step", before.info["draw"] is None):
            world = _step(self.env, before, low + (action + 1) / 2 * (high - low))
        # Brax would take the task's own time limit for a failure. A clock that stands still never
        # gets there.
        clock = jnp.zeros_like(world.info["steps"])
        world = dataclasses.replace(world, info=world.info | {"steps": clock})
        reward = jnp.where(before.done, 0.0, world.reward)
        metrics = state.metrics | world.metrics  # wrappers add their own
        return state.replace(reward=reward, metrics=metrics, **self._seen(world))

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return jax.eval_shape(self.reset, jax.random.key(0)).obs.shape[0]

    @property
    def action_size(self) -> int:
        """A."""
        return len(self.env.action_low)

    @property
    def backend(self) -> str:
        """The physics engine."""
        return "mjx"

    def _seen(self, world: State) -> dict[str, Any]:
        """The fields of Brax's state that say how one world, without an axis W, is now."""
        return {
            "pipeline_state": jax.tree.map(lambda x: x[None], world),
            "obs": _full_state(self.env, world),
            "done": world.done.astype(jnp.float32),
        }
