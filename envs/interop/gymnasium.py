"""An environment as a Gymnasium vector environment: NumPy outside, jitted JAX inside.

env = VectorEnv(envs.make("press", num_envs=64, image_size=64))
observation, info = env.reset(seed=0)
observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

`gymnasium.make_vec` and `gymnasium.make` call `make_vec` and `make` (`envs.interop.ids`).
"""

import dataclasses
from typing import Any, ClassVar, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from envs import checks
from envs.env import Env
from envs.making import make as make_env
from envs.scene.randomization import Randomization, prepared
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


Observation = Literal["pictures", "state", "full_state"]
OBSERVATIONS: tuple[str, ...] = get_args(Observation)
"""state: a dict of `state`, float32 [J + 1], measured joint angles [rad] and gripper opening [m];
pictures: with `image`, too, camera name -> uint8 [image_size, image_size, 3]; full_state: the flat
vector of `Env.full_state`, objects and speeds included, float32 [D]."""


class VectorEnv(gymnasium.vector.VectorEnv):
    """W worlds of a task behind Gymnasium's interface.

    Observations are what `OBSERVATIONS` says, with leading axis W. Actions are those of `Env.step`,
    float32 [W, A]. Info: `success`, bool [W], and `instruction`, text [W].

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

    def __init__(
        self,
        env: Env,
        *,
        observation: Observation = "pictures",
        ranges: Randomization | None = None,
    ):
        """Wrap an environment.

        Args:
            env: what `envs.make` gave.
            observation: pictures, which cost more than the physics, state or full_state.
            ranges: as for `Env.reset`, for every episode.

        Raises:
            TypeError: if it is no environment.
            ValueError: for an unknown observation, or if the ranges make no sense.
        """
        checks.instance("env", env, Env, "what envs.make gave")
        self.env = env
        self.observation = observation
        prepared(ranges, env.control_dt)
        self.ranges = ranges
        self.state: State | None = None
        self.num_envs = env.num_envs
        self.single_action_space = spaces.Box(env.action_low, env.action_high)
        self.single_observation_space = _space(env, observation)
        self.action_space = batch_space(self.single_action_space, env.num_envs)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
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
    ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Simulate one control step of every world, or restart it if it had ended.

        Args:
            actions: [W, A], units and limits as for `Env.step`.

        Returns:
            Observation; reward, float32 [W], as `envs.make` was asked for it; terminated, bool [W],
            the task is done; truncated, bool [W], time is up or the physics broke; info.

        Raises:
            gymnasium.error.ResetNeeded: before the first `reset`.
            TypeError, ValueError: if the actions are no numbers, or have another shape.
        """
        if self.state is None:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        actions = checks.action(np.asarray(actions), (self.num_envs, len(self.env.action_low)))
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

    def _observation(self, state: State) -> Any:
        return _look(self.env, state, self.observation)

    def _info(self, state: State) -> dict[str, Any]:
        instructions = np.array(self.env.instructions)
        info = {
            "success": np.array(state.info["success"]),
            "instruction": instructions[np.asarray(state.info["instruction"])],
        }
        # Gymnasium's mark of the worlds that an entry is about: all of them.
        return info | {f"_{name}": np.ones(self.num_envs, bool) for name in info}


class SingleEnv(gymnasium.Env):
    """One world of a task as a Gymnasium environment; `VectorEnv` is far faster.

    As `VectorEnv`, without its axis of worlds and without restarts.

    Attributes:
        vector: the environment inside, of one world.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, env: Env, *, render_mode: str | None = None, **options: Any):
        """Wrap an environment.

        Args:
            env: what `envs.make` gave; its number of worlds does not matter.
            render_mode: rgb_array for `render`.
            **options: of `VectorEnv`.

        Raises:
            ValueError: for an unknown observation or render mode.
        """
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r}: choose from rgb_array")
        checks.instance("env", env, Env, "what envs.make gave")
        self.render_mode = render_mode
        self.metadata = self.metadata | {"render_fps": round(1 / env.control_dt)}
        self.vector = VectorEnv(dataclasses.replace(env, num_envs=1), **options)
        self.action_space = self.vector.single_action_space
        self.observation_space = self.vector.single_observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """As `VectorEnv.reset`."""
        super().reset(seed=seed)
        found = self.vector.reset(seed=int(self.np_random.integers(2**31)), options=options)
        return _first(found[0]), self._info(found[1])

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """As `VectorEnv.step`.

        Args:
            action: [A].

        Raises:
            gymnasium.error.ResetNeeded: before the first `reset` and after an end.
            ValueError: if the action has another shape.
        """
        state = self.vector.state
        if state is not None and bool(state.done[0]):
            raise gymnasium.error.ResetNeeded("the episode has ended: call reset")
        seen, reward, terminated, truncated, info = self.vector.step(np.asarray(action)[None])
        ends = bool(terminated[0]), bool(truncated[0])
        return _first(seen), float(reward[0]), *ends, self._info(info)

    def render(self) -> np.ndarray:
        """The side camera's picture, uint8 [image_size, image_size, 3].

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
    """A `VectorEnv` of what `envs.make` makes with these options."""
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
    """A `SingleEnv` of what `envs.make` makes with these options."""
    env = make_env(task, robot, **options)
    return SingleEnv(env, observation=observation, ranges=ranges, render_mode=render_mode)


def _space(env: Env, observation: str) -> spaces.Space:
    """The space of one world's observations; no bounds, for joints give way at their limits."""
    if observation not in OBSERVATIONS:
        raise ValueError(
            f"unknown observation {observation!r}: choose from {', '.join(OBSERVATIONS)}"
        )
    if observation == "full_state":
        length = max(part.stop for part in env.full_state_layout.values())
        return spaces.Box(-np.inf, np.inf, (length,))
    seen: dict[str, spaces.Space] = {"state": spaces.Box(-np.inf, np.inf, (env.num_joints + 1,))}
    if observation == "pictures":
        picture = spaces.Box(0, 255, (env.image_size, env.image_size, 3), np.uint8)
        seen["image"] = spaces.Dict(dict.fromkeys(env.cameras, picture))
    return spaces.Dict(seen)


def _look(env: Env, state: State, observation: str) -> Any:
    if observation == "full_state":
        seen = env.full_state(state)
    else:
        seen = env.observe(state) if observation == "pictures" else {"state": env.proprio(state)}
    return jax.tree.map(np.array, seen)  # copies, because JAX's own memory is read-only


def _first(seen: Any) -> Any:
    return jax.tree.map(lambda x: x[0], seen)
