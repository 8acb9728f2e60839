"""Wrap an environment as a Gymnasium vector environment: NumPy outside, jitted JAX inside.

env = VectorEnv(envs.make("press", num_envs=64, image_size=64))
observation, info = env.reset(seed=0)
observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

`gymnasium.make_vec` and `gymnasium.make` call `make_vec` and `make` of this module, which
`envs.interop.ids` registers.
"""

import dataclasses
from typing import Any, ClassVar, Literal, get_args

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from envs import checks
from envs.env import Env
from envs.making import make as make_env
from envs.scene.randomization import prepare
from envs.scene.ranges import Randomization
from envs.state import State

Observation = Literal["pictures", "state", "full_state"]
OBSERVATIONS: tuple[str, ...] = get_args(Observation)
"""state: dict with `state`, float32 [J + 1], measured joint angles [rad] and gripper opening [m].
pictures: the same plus `image`, dict from camera name to uint8 `[image_size, image_size, 3]`.
full_state: the privileged state of `Env.full_state`, float32 `[D]`."""


class VectorEnv(gymnasium.vector.VectorEnv):
    """W worlds of a task behind Gymnasium's interface.

    Observations are one of `OBSERVATIONS`, with a leading axis W. Actions are as in `Env.step`,
    float32 `[W, A]`. Info has `success`, bool `[W]`, and `instruction`, string `[W]`.

    Worlds restart automatically in Gymnasium's next-step mode: the step after a world ends ignores
    its action and returns the first observation of its next episode. That step has reward 0 and is
    neither terminated nor truncated. The seed determines all randomness, including restarts.

    Attributes:
        env: the wrapped environment.
        ranges: domain randomization.
        state: the W worlds, for access to metrics and layouts; None before `reset`.
    """

    metadata: ClassVar[dict[str, Any]] = {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        env: Env,
        *,
        observation: Observation = "pictures",
        ranges: Randomization | None = None,
    ):
        """Wrap an environment.

        Args:
            env: from `envs.make`.
            observation: one of `OBSERVATIONS`; rendering images costs more than the physics.
            ranges: domain randomization of every episode, as in `Env.reset`.

        Raises:
            ValueError: the observation is unknown, or a range is invalid.
        """
        self.env = env
        self.observation = observation
        prepare(ranges, env.control_dt)
        self.ranges = ranges
        self.state: State | None = None
        self.num_envs: int = env.num_envs
        self.single_action_space: spaces.Space[Any] = spaces.Box(env.action_low, env.action_high)
        self.single_observation_space: spaces.Space[Any] = _space(env, observation)
        self.action_space: spaces.Space[Any] = batch_space(self.single_action_space, env.num_envs)
        self.observation_space: spaces.Space[Any] = batch_space(
            self.single_observation_space, env.num_envs
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Restart all worlds; return observation and info.

        Args:
            seed: seed of all randomness; None continues the previous random sequence.
            options: not supported.

        Raises:
            ValueError: options were passed.
        """
        if options:
            raise ValueError(f"reset takes no options, got {', '.join(options)}")
        super().reset(seed=seed)
        self.state = state = self.env.reset(self._key(), self.ranges)
        return self._observation(state), self._info(state)

    def step(
        self, actions: np.ndarray
    ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Simulate one control step of every world, and restart the worlds that have ended.

        Args:
            actions: `[W, A]`, units and limits as in `Env.step`.

        Returns:
            Observation, reward, terminated, truncated and info. The reward, float32 [W], is sparse
            or dense as chosen in `envs.make`. Worlds terminate on success, bool `[W]`, and are
            truncated by the time limit or broken physics, bool `[W]`.

        Raises:
            gymnasium.error.ResetNeeded: before the first `reset`.
            ValueError: the shape of the actions is wrong.
        """
        if self.state is None:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        actions = checks.action(np.asarray(actions), (self.num_envs, len(self.env.action_low)))
        self.state = state = self._advance(self.state, jnp.asarray(actions, jnp.float32))
        done, success = np.asarray(state.done), np.asarray(state.info["success"])
        observation, reward = self._observation(state), np.array(state.reward)
        return observation, reward, done & success, done & ~success, self._info(state)

    def _advance(self, state: State, actions: jax.Array) -> State:
        """Step all worlds, and restart those that ended before this step."""
        after = self.env.step(state, actions)
        ended = state.done
        if not np.any(ended):
            return after
        # Restart only worlds that ended earlier: the caller must still see those that end now.
        ended_only = dataclasses.replace(after, done=ended)
        fresh = self.env.reset_done(ended_only, self._key(), self.ranges)
        return dataclasses.replace(fresh, done=after.done & ~ended)

    def _key(self) -> jax.Array:
        return jax.random.key(int(self.np_random.integers(2**31)))

    def _observation(self, state: State) -> Any:
        return _observe(self.env, state, self.observation)

    def _info(self, state: State) -> dict[str, Any]:
        instructions = np.array(self.env.instructions)
        info = {
            "success": np.array(state.info["success"]),
            "instruction": instructions[np.asarray(state.info["instruction"])],
        }
        # Gymnasium's mask of the worlds that an entry applies to: all of them.
        return info | {f"_{name}": np.ones(self.num_envs, bool) for name in info}


class SingleEnv(gymnasium.Env):
    """One world of a task as a Gymnasium environment; `VectorEnv` is far faster.

    Like `VectorEnv`, but without the axis of worlds and without automatic restarts.

    Attributes:
        vector: the wrapped environment, with one world.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, env: Env, *, render_mode: str | None = None, **options: Any):
        """Wrap an environment.

        Args:
            env: from `envs.make`; its number of worlds is ignored.
            render_mode: rgb_array to use `render`, else None.
            **options: keyword arguments of `VectorEnv`.

        Raises:
            ValueError: the observation or the render mode is unknown.
        """
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self.render_mode = render_mode
        self.metadata = self.metadata | {"render_fps": round(1 / env.control_dt)}
        self.vector: VectorEnv = VectorEnv(dataclasses.replace(env, num_envs=1), **options)
        self.action_space: spaces.Space[Any] = self.vector.single_action_space
        self.observation_space: spaces.Space[Any] = self.vector.single_observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Restart the world; see `VectorEnv.reset`."""
        super().reset(seed=seed)
        vector_seed = int(self.np_random.integers(2**31))
        observation, info = self.vector.reset(seed=vector_seed, options=options)
        return _first(observation), self._info(info)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Simulate one control step; see `VectorEnv.step`.

        Args:
            action: `[A]`.

        Raises:
            gymnasium.error.ResetNeeded: before the first `reset`, and after the end of an episode.
            ValueError: as in `VectorEnv.step`.
        """
        state = self.vector.state
        if state is not None and bool(state.done[0]):
            raise gymnasium.error.ResetNeeded("the episode has ended: call reset")
        batched = self.vector.step(np.asarray(action)[None])
        observation, reward, terminated, truncated, info = batched
        ends = bool(terminated[0]), bool(truncated[0])
        return _first(observation), float(reward[0]), *ends, self._info(info)

    def render(self) -> np.ndarray:
        """Render the side camera, uint8 `[image_size, image_size, 3]`.

        Raises:
            gymnasium.error.ResetNeeded: before the first `reset`.
        """
        if self.vector.state is None:
            raise gymnasium.error.ResetNeeded("call reset before render")
        return np.array(self.vector.env.observe(self.vector.state)["image"]["side"][0])

    def _info(self, info: dict[str, Any]) -> dict[str, Any]:
        return {name: value[0].item() for name, value in info.items() if name[0] != "_"}


def make_vec(
    task: str,
    robot: str,
    num_envs: int = 1,
    *,
    observation: Observation = "full_state",
    ranges: Randomization | None = None,
    **options: Any,
) -> VectorEnv:
    """Make a `VectorEnv`; further options are those of `envs.make`."""
    env = make_env(task, robot, num_envs=num_envs, **options)
    return VectorEnv(env, observation=observation, ranges=ranges)


def make(
    task: str,
    robot: str,
    *,
    observation: Observation = "full_state",
    ranges: Randomization | None = None,
    render_mode: str | None = None,
    **options: Any,
) -> SingleEnv:
    """Make a `SingleEnv`; further options are those of `envs.make`."""
    env = make_env(task, robot, **options)
    return SingleEnv(env, observation=observation, ranges=ranges, render_mode=render_mode)


def _space(env: Env, observation: str) -> spaces.Space[Any]:
    """Return one world's observation space; joints can exceed limits, so states are unbounded."""
    checks.choice("observation", observation, OBSERVATIONS)
    if observation == "full_state":
        length = max(part.stop for part in env.full_state_layout.values())
        return spaces.Box(-np.inf, np.inf, (length,))
    parts: dict[str, spaces.Space] = {"state": spaces.Box(-np.inf, np.inf, (env.num_joints + 1,))}
    if observation == "pictures":
        image = spaces.Box(0, 255, (env.image_size, env.image_size, 3), np.uint8)
        parts["image"] = spaces.Dict(dict.fromkeys(env.cameras, image))
    return spaces.Dict(parts)


def _observe(env: Env, state: State, observation: str) -> Any:
    if observation == "full_state":
        values = env.full_state(state)
    elif observation == "pictures":
        values = env.observe(state)
    else:
        values = {"state": env.proprio(state)}
    return jax.tree.map(np.array, values)  # copy: JAX's buffers are read-only


def _first(observation: Any) -> Any:
    return jax.tree.map(lambda x: x[0], observation)
