"""Expert episodes in bulk: the whole of an episode, pictures included, in one jitted call.

An episode is one scan over control steps in W worlds that records robot states, actions and the
poses of all geoms and cameras; pictures are rendered from those poses in bounded memory.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs import checks
from envs.datasets.episodes import Episodes, concatenate
from envs.env import Env
from envs.experts import expert, traced
from envs.making import AnyRobot, make
from envs.scene.randomization import Draw, Randomization, prepared

# Worlds a call, where nobody says otherwise: enough to fill the device, few enough for its memory.
_NUM_ENVS = {"cpu": 32, "gpu": 256, "tpu": 256}
# Below this share of successes, once so many attempts were made, something is broken, and going on
# would only waste time.
_LEAST_SUCCESS, _PATIENCE = 0.5, 16
_MOST_EPISODES = 10**9


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
        draw: what the worlds drew, or None.
    """

    state: jax.Array
    action: jax.Array
    poses: tuple[jax.Array, ...]
    length: jax.Array
    success: jax.Array
    instruction: jax.Array
    draw: Draw | None


def rollout(
    env: Env,
    key: jax.Array,
    action_noise: float | jax.Array = 0.0,
    ranges: Randomization | None = None,
) -> Rollout:
    """The expert's attempt at fresh random layouts; to be called under jit.

    Args:
        env: W worlds.
        key: all randomness.
        action_noise: standard deviation [rad] of gaussian noise on the executed joint targets. The
            recorded actions are free of it, so they show how to recover.
        ranges: what differs from world to world, see `envs.scene.randomization`.
    """
    reset_key, plan_key, noise_key = jax.random.split(key, 3)
    first = env.reset(reset_key, ranges)
    plan = expert.plan(env, first, plan_key)

    def body(state: Any, key: jax.Array) -> tuple[Any, tuple]:
        action = expert.act(env, plan, state)
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
        draw=first.info["draw"],
    )


def collect(
    task: str,
    robot: AnyRobot = "piper",
    *,
    num_episodes: int,
    key: jax.Array,
    num_envs: int | None = None,
    action_noise: float = 0.0,
    ranges: Randomization | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> Episodes:
    """Successful demonstrations by the scripted expert, on the device, padded to its longest time.

    Args:
        task: as for `envs.make`.
        robot: as for `envs.make`.
        num_episodes: episodes E to return.
        key: all randomness; the same key gives the same episodes.
        num_envs: worlds W simulated at once; None picks by device.
        action_noise: see `rollout`.
        ranges: see `rollout`.
        progress: called with (episodes so far, num_episodes), first with 0 before compilation.
        **options: others of `envs.make`; the backend is jax unless they say otherwise.

    Raises:
        TypeError: for what is no number or no key.
        ValueError: for bad names or numbers, or if the expert fails far too often.
    """
    env = make_repeatable(task, robot, num_envs=worlds(num_episodes, num_envs), **options)
    parts = gather(env, num_episodes, key, action_noise, ranges)
    return concatenate(list(_reported(parts, num_episodes, progress)))


def expert_success(
    task: str,
    robot: AnyRobot = "piper",
    *,
    num_episodes: int,
    key: jax.Array,
    num_envs: int | None = None,
    ranges: Randomization | None = None,
    **options: Any,
) -> jax.Array:
    """Whether the expert solves each of `num_episodes` random layouts, bool [num_episodes].

    Arguments are those of `collect`.
    """
    env = make_repeatable(task, robot, num_envs=worlds(num_episodes, num_envs), **options)
    ranges = prepared(ranges, env.control_dt)
    checks.key(key)
    calls = -(-num_episodes // env.num_envs)
    results = [_attempt(env, chunk_key, ranges) for chunk_key in jax.random.split(key, calls)]
    return jnp.concatenate(results)[:num_episodes]


def make_repeatable(task: str, robot: AnyRobot, **options: Any) -> Env:
    """`envs.make` with physics that gives the same again: Warp sums forces in any order."""
    options.setdefault("backend", "jax")
    return make(task, robot, **options)


def gather(
    env: Env,
    num_episodes: int,
    key: jax.Array,
    action_noise: float = 0.0,
    ranges: Randomization | None = None,
    *,
    kept: int = 0,
    attempted: int = 0,
) -> Iterator[Episodes]:
    """Yields successes of one call after the other, until there are `num_episodes`.

    Args:
        env: W worlds, the attempts of one call.
        num_episodes, key, action_noise, ranges: as for `collect`.
        kept, attempted: num_episodes and attempted of all that was yielded before, to go on as if
            it had never stopped.

    Raises:
        ValueError: if the expert fails far too often.
    """
    ranges = prepared(ranges, env.control_dt)
    checks.key(key)
    if checks.number("action_noise", action_noise) < 0:
        raise ValueError(f"action_noise must be at least 0, got {action_noise}")
    for _ in range(attempted // env.num_envs):
        key, _ = jax.random.split(key)
    tried = 0  # since the last success
    while kept < num_episodes:
        _check_success(env, kept, attempted)
        key, chunk_key = jax.random.split(key)
        # Waiting here, a thread leaves Python to those that write what others recorded.
        chunk, success = jax.block_until_ready(_record(env, chunk_key, action_noise, ranges))
        wins = np.flatnonzero(success)[: num_episodes - kept]
        kept += len(wins)
        # Attempts after the last one that was needed do not count.
        tries = env.num_envs if kept < num_episodes else int(wins[-1]) + 1
        attempted, tried = attempted + tries, tried + tries
        if len(wins):
            won = jax.tree.map(lambda x, wins=wins: x[wins], chunk)
            yield Episodes(**won, **_facts(env), attempted=tried)
            tried = 0


def _facts(env: Env) -> dict[str, Any]:
    """What `Episodes` say of where they come from."""
    return {
        "instructions": env.instructions,
        "task": env.task.name,
        "robot": env.robot.name,
        "control_dt": env.control_dt,
        "physics_dt": env.physics_dt,
        "actions": env.actions,
    }


def _reported(
    parts: Iterable[Episodes], total: int, progress: Callable[[int, int], None] | None
) -> Iterator[Episodes]:
    """The same parts, with progress before the first and after each."""
    report = progress or _silent
    report(0, total)
    done = 0
    for part in parts:
        done += part.num_episodes
        report(done, total)
        yield part


def _silent(done: int, total: int) -> None:
    """The progress callback of nobody."""


def _check_success(env: Env, kept: int, attempted: int) -> None:
    if attempted >= _PATIENCE and kept < _LEAST_SUCCESS * attempted:
        raise ValueError(
            f"the expert solved only {kept} of {attempted} layouts of {env.task.name!r} with "
            f"{env.robot.name!r}, at least {_LEAST_SUCCESS:.0%} are expected: check the scene "
            "or lower action_noise"
        )


@traced.kept
def _record(
    env: Env, key: jax.Array, action_noise: jax.Array, ranges: Randomization | None
) -> tuple[dict[str, Any], jax.Array]:
    tries = rollout(env, key, action_noise, ranges)
    steps, worlds = tries.action.shape[:2]
    # World-major order, so that an episode's pictures end up next to each other.
    flat = [jnp.swapaxes(x, 0, 1).reshape(-1, *x.shape[2:]) for x in tries.poses]
    drawn = jax.tree.map(lambda x: jnp.repeat(x, steps, axis=0), tries.draw)
    pictures = env.render(*flat, draw=drawn)
    episodes = {
        "image": {k: x.reshape(worlds, steps, *x.shape[1:]) for k, x in pictures.items()},
        "state": jnp.swapaxes(tries.state, 0, 1),
        "action": jnp.swapaxes(tries.action, 0, 1),
        "length": tries.length,
        "instruction": tries.instruction,
    }
    return episodes, tries.success


@traced.kept
def _attempt(env: Env, key: jax.Array, ranges: Randomization | None) -> jax.Array:
    return rollout(env, key, ranges=ranges).success


def worlds(num_episodes: int, num_envs: int | None) -> int:
    """Worlds at once for so many episodes, where `num_envs` does not say it."""
    num_episodes = checks.count("num_episodes", num_episodes, _MOST_EPISODES)
    if num_envs is not None:
        return num_envs
    return min(num_episodes, _NUM_ENVS.get(jax.default_backend(), 256))
