"""Expert episodes in bulk: the whole of an episode, pictures included, in one jitted call.

An episode is one scan over control steps in W worlds that records robot states, actions and the
poses of all geoms and cameras; pictures are rendered from those poses in bounded memory.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs import experts
from envs.env import Env
from envs.episodes import Episodes
from envs.making import make

# Worlds a call, where nobody says otherwise: enough to fill the device, few enough for its memory.
_NUM_ENVS = {"cpu": 32, "gpu": 256, "tpu": 256}
# Below this share of successes, once so many attempts were made, something is broken, and going on
# would only waste time.
_LEAST_SUCCESS, _PATIENCE = 0.5, 16


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Rollout:
    """One expert episode in each of W worlds, T control steps.

    Attributes:
        state: f32 [T, W, J + 1] measured joints [rad] and gripper opening [m] before each action.
        action: f32 [T, W, J + 1] what the expert asked for, without noise.
        poses: geom_xpos, geom_xmat, cam_xpos, cam_xmat, each [T, W, ...], as the pictures see them.
        length: int32 [W] control steps until the world was done.
        success: bool [W].
        instruction: int32 [W].
    """

    state: jax.Array
    action: jax.Array
    poses: tuple[jax.Array, ...]
    length: jax.Array
    success: jax.Array
    instruction: jax.Array


def rollout(env: Env, key: jax.Array, action_noise: float | jax.Array = 0.0) -> Rollout:
    """The expert's attempt at fresh random layouts; to be called under jit.

    Args:
        env: W worlds.
        key: all randomness.
        action_noise: standard deviation [rad] of gaussian noise on the executed joint targets. The
            recorded actions are free of it, so they show how to recover.
    """
    reset_key, plan_key, noise_key = jax.random.split(key, 3)
    first = env.reset(reset_key)
    plan = experts.plan(env, first, plan_key)

    def body(state: Any, key: jax.Array) -> tuple[Any, tuple]:
        action = experts.act(env, plan, state)
        noise = action_noise * jax.random.normal(key, action.shape).at[:, -1].set(0.0)
        data = state.data
        poses = (data.geom_xpos, data.geom_xmat, data.cam_xpos, data.cam_xmat)
        return env.step(state, action + noise), (env.proprio(state), action, poses, ~state.done)

    keys = jax.random.split(noise_key, env.expert_steps)
    last, (state, action, poses, alive) = jax.lax.scan(body, first, keys)
    return Rollout(
        state=state,
        action=action,
        poses=poses,
        length=jnp.sum(alive, axis=0, dtype=jnp.int32),
        success=last.info["success"],
        instruction=last.info["instruction"],
    )


def collect(
    task: str,
    robot: str = "piper",
    *,
    num_episodes: int,
    key: jax.Array,
    image_size: int = 64,
    num_envs: int | None = None,
    control_dt: float = 0.1,
    action_noise: float = 0.0,
    antialias: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Episodes:
    """Demonstrations by the scripted expert; only successful ones are kept.

    Args:
        task, robot, image_size, control_dt, antialias: as for `envs.make`.
        num_episodes: episodes E to return.
        key: all randomness; the same key gives the same episodes.
        num_envs: worlds W simulated at once; None picks by device.
        action_noise: see `rollout`.
        progress: called with (episodes so far, num_episodes), first with 0 before compilation.

    Returns:
        Episodes whose arrays stay on the device, padded to the expert's longest time.

    Raises:
        ValueError: for bad names or numbers, or if the expert fails far too often.
    """
    env = make(
        task,
        robot,
        num_envs=_worlds(num_episodes, num_envs),
        image_size=image_size,
        control_dt=control_dt,
        antialias=antialias,
    )
    return _gather(env, num_episodes, key, action_noise, progress or _silent)


def expert_success(
    task: str,
    robot: str = "piper",
    *,
    num_episodes: int,
    key: jax.Array,
    num_envs: int | None = None,
) -> jax.Array:
    """Whether the expert solves each of `num_episodes` random layouts, bool [num_episodes]."""
    env = make(task, robot, num_envs=_worlds(num_episodes, num_envs))
    calls = -(-num_episodes // env.num_envs)
    results = [_attempt(env, chunk_key) for chunk_key in jax.random.split(key, calls)]
    return jnp.concatenate(results)[:num_episodes]


def _gather(
    env: Env,
    num_episodes: int,
    key: jax.Array,
    action_noise: float,
    progress: Callable[[int, int], None],
) -> Episodes:
    """The first `num_episodes` successes."""
    chunks: list[dict[str, Any]] = []
    kept = attempted = 0
    progress(0, num_episodes)
    while kept < num_episodes:
        if attempted >= _PATIENCE and kept < _LEAST_SUCCESS * attempted:
            raise ValueError(
                f"the expert solved only {kept} of {attempted} layouts of {env.task.name!r} with "
                f"{env.robot.name!r}, at least {_LEAST_SUCCESS:.0%} are expected: check the scene "
                "or lower action_noise"
            )
        key, chunk_key = jax.random.split(key)
        chunk, success = _record(env, chunk_key, action_noise)
        wins = np.flatnonzero(success)[: num_episodes - kept]
        kept += len(wins)
        # Attempts after the last one that was needed do not count.
        attempted += env.num_envs if kept < num_episodes else int(wins[-1]) + 1
        chunks.append(jax.tree.map(lambda x, wins=wins: x[wins], chunk))
        progress(kept, num_episodes)
    return Episodes(
        **jax.tree.map(lambda *parts: jnp.concatenate(parts), *chunks),
        instructions=env.instructions,
        task=env.task.name,
        robot=env.robot.name,
        control_dt=env.control_dt,
        physics_dt=env.physics_dt,
        attempted=attempted,
    )


def _silent(done: int, total: int) -> None:
    """The progress callback of nobody."""


@functools.partial(jax.jit, static_argnums=0)
def _record(env: Env, key: jax.Array, action_noise: jax.Array) -> tuple[dict[str, Any], jax.Array]:
    tries = rollout(env, key, action_noise)
    steps, worlds = tries.action.shape[:2]
    # World-major order, so that an episode's pictures end up next to each other.
    flat = [jnp.swapaxes(x, 0, 1).reshape(-1, *x.shape[2:]) for x in tries.poses]
    pictures = env.render(*flat)
    episodes = {
        "image": {k: x.reshape(worlds, steps, *x.shape[1:]) for k, x in pictures.items()},
        "state": jnp.swapaxes(tries.state, 0, 1),
        "action": jnp.swapaxes(tries.action, 0, 1),
        "length": tries.length,
        "instruction": tries.instruction,
    }
    return episodes, tries.success


@functools.partial(jax.jit, static_argnums=0)
def _attempt(env: Env, key: jax.Array) -> jax.Array:
    return rollout(env, key).success


def _worlds(num_episodes: int, num_envs: int | None) -> int:
    if num_episodes < 1:
        raise ValueError(f"num_episodes must be at least 1, got {num_episodes}")
    return num_envs or min(num_episodes, _NUM_ENVS.get(jax.default_backend(), 256))
