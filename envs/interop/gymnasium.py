"""An environment as a Gymnasium vector environment: NumPy outside, jitted JAX inside.

env = VectorEnv(envs.make("press", num_envs=64, image_size=64))
observation, info = env.reset(seed=0)
observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from envs.env import Env
from envs.randomization import Randomization
from envs.state import State

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError(
        'envs.interop.gymnasium needs Gymnasium: pip install -e ".[gymnasium]"'
    ) from error


class VectorEnv(gymnasium.vector.VectorEnv):
    """W worlds of a task behind Gymnasium's interface.

    Observations: `state`, float32 [W, J + 1], measured joint angles [rad] and gripper opening [m];
    with pictures also `image`, camera name -> uint8 [W, image_size, image_size, 3]. Actions are
    those of `Env.step`, float32 [W, A]. Info: `success`, bool [W], and `instruction`, text [W].

    Worlds restart by themselves in Gymnasium's next-step mode: the step after a world ended ignores
    its action and gives the first observation of its next episode, with reward 0 and neither
    terminated nor truncated. A seed and the actions determine everything that follows, restarts
    included.

    Attributes:
        env: the environment inside.
        ranges: how its worlds differ.
        state: its W worlds, for what the interface hides (metrics, layouts); None before `reset`.
    """

    metadata: ClassVar[dict[str, Any]] = {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(self, env: Env, *, pictures: bool = True, ranges: Randomization | None = None):
        """Wrap an environment.

        Args:
            env: what `envs.make` gave.
            pictures: whether observations hold pictures, which cost more than the physics.
            ranges: as for `Env.reset`, for every episode.
        """
        self.env = env
        self.ranges = ranges
        self.state: State | None = None
        self.num_envs = env.num_envs
        self.single_action_space = spaces.Box(env.action_low, env.action_high)
        # No bounds: joints give way a little at their limits.
        proprio = spaces.Box(-np.inf, np.inf, (env.num_joints + 1,))
        seen: dict[str, spaces.Space] = {"state": proprio}
        if pictures:
            picture = spaces.Box(0, 255, (env.image_size, env.image_size, 3), np.uint8)
            seen["image"] = spaces.Dict(dict.fromkeys(env.cameras, picture))
        self.single_observation_space = spaces.Dict(seen)
        self.action_space = batch_space(self.single_action_space, env.num_envs)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start all worlds afresh: observation and info.

        Args:
            seed: of all randomness from now on; None goes on from the seed before.
            options: there are none.

        Raises:
            ValueError: if options are given.
        """
        if options:
            raise ValueError(f"reset takes no options, got {', '.join(options)}")
        super().reset(seed=seed)
        self.state = state = self.env.reset(self._key(), self.ranges)
        return self._observation(state), self._info(state)

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Simulate one control step of every world, or restart it if it had ended.

        Args:
            actions: [W, A], units and limits as for `Env.step`.

        Returns:
            Observation; reward, float32 [W], 1 for success; terminated, bool [W], the task is done;
            truncated, bool [W], time is up or the physics broke; info.

        Raises:
            gymnasium.error.ResetNeeded: before the first `reset`.
            ValueError: if the actions have another shape.
        """
        if self.state is None:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        self.state = state = self._advance(self.state, jnp.asarray(actions, jnp.float32))
        done, success = np.asarray(state.done), np.asarray(state.info["success"])
        observation, reward = self._observation(state), np.array(state.reward)
        return observation, reward, done & success, done & ~success, self._info(state)

    def _advance(self, state: State, actions: jax.Array) -> State:
        """The worlds one step later; those that had ended, which stand still, are fresh instead."""
        after = self.env.step(state, actions)
        ended = state.done
        if not np.any(ended):
            return after
        # Worlds that ended in this very step must still be seen: only the earlier ones restart.
        ended_only = dataclasses.replace(after, done=ended)
        fresh = self.env.reset_done(ended_only, self._key(), self.ranges)
        return dataclasses.replace(fresh, done=after.done & ~ended)

    def _key(self) -> jax.Array:
        return jax.random.key(int(self.np_random.integers(2**31)))

    def _observation(self, state: State) -> dict[str, Any]:
        if "image" in self.single_observation_space.spaces:
            seen = self.env.observe(state)
        else:
            seen = {"state": self.env.proprio(state)}
        return jax.tree.map(np.array, seen)  # copies, because JAX's own memory is read-only

    def _info(self, state: State) -> dict[str, Any]:
        instructions = np.array(self.env.instructions)
        info = {
            "success": np.array(state.info["success"]),
            "instruction": instructions[np.asarray(state.info["instruction"])],
        }
        # Gymnasium's mark of the worlds that an entry is about: all of them.
        return info | {f"_{name}": np.ones(self.num_envs, bool) for name in info}
