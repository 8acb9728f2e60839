"""Collect batches of expert demonstrations, including images, in one jitted call per batch.

A call scans over the control steps of one episode in W worlds. It records robot states, actions and
the poses of all geoms and cameras, then renders images from those poses in bounded memory.
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs import checks, traced
from envs.datasets.episodes import Episodes, concatenate
from envs.env import Env
from envs.experts import expert
from envs.making import AnyRobot, make
from envs.scene.randomization import prepare
from envs.scene.ranges import Randomization
from envs.state import Poses, State

# Default number of worlds per call, our choice: enough to fill the device, within its memory.
_NUM_ENVS = {"cpu": 32, "gpu": 256, "tpu": 256}
# Give up if less than this share of at least this many attempts has succeeded. Our choice: the
# experts solve nearly all layouts, so a lower share means that something is broken.
_MIN_SUCCESS, _MIN_ATTEMPTS = 0.5, 16
_MAX_EPISODES = 10**9  # our choice; catches typos


def rollout(
    env: Env,
    key: jax.Array,
    action_noise: float | jax.Array = 0.0,
    ranges: Randomization | None = None,
) -> tuple[State, Poses, dict[str, jax.Array], jax.Array]:
    """Run the expert on fresh random layouts; call this function under jit.

    Args:
        env: W worlds.
        key: source of all randomness.
        action_noise: standard deviation of Gaussian noise on the executed actions, in their units
            [rad, or m for the tcp's translation]. The gripper opening gets no noise. Recorded
            actions are without noise, so they demonstrate recovery.
        ranges: domain randomization, see `envs.scene.randomization`.

    Returns:
        The worlds at reset; the poses before each of the T actions, leading axes `[W, T]`; the
        arrays of `Episodes` except images; success, bool `[W]`.
    """
    reset_key, plan_key, noise_key = jax.random.split(key, 3)
    first = env.reset(reset_key, ranges)
    plan = expert.plan(env, first, plan_key)

    def body(state: Any, key: jax.Array) -> tuple[Any, tuple]:
        action = expert.act(env, plan, state)
        noise = action_noise * jax.random.normal(key, action.shape).at[:, -1].set(0.0)
        record = (env.proprio(state), action, Poses.of(state.data), ~state.done)
        return env.step(state, action + noise), record

    keys = jax.random.split(noise_key, env.expert_steps)
    last, (state, action, poses, alive) = jax.lax.scan(body, first, keys)
    # World-major order, so that the images of an episode are contiguous.
    poses, state, action = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), (poses, state, action))
    episodes = {
        "state": state,
        "action": action,
        "length": jnp.sum(alive, axis=0, dtype=jnp.int32),
        "instruction": last.info["instruction"],
    }
    return first, poses, episodes, last.info["success"]


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
    """Collect successful demonstrations of the scripted expert, in host memory.

    Episodes are padded to the expert's time limit.

    Args:
        task: name of the task.
        robot: robot, its name, or the path of an MJCF file.
        num_episodes: number of episodes E to return.
        key: source of all randomness; the same key gives the same episodes.
        num_envs: number of worlds W simulated at once; None: chosen by device.
        action_noise: as in `rollout`.
        ranges: as in `rollout`.
        progress: called with (episodes so far, num_episodes), first with 0 before compilation.
        **options: further options of `envs.make`; the backend defaults to jax.

    Raises:
        TypeError: an argument has the wrong type.
        ValueError: a name is unknown, a number is out of range, or the expert fails too often.
    """
    env = make_repeatable(task, robot, num_envs=worlds(num_episodes, num_envs), **options)
    report = progress or (lambda *_: None)
    report(0, num_episodes)
    parts = []
    for part in gather(env, num_episodes, key, action_noise, ranges):
        parts.append(part)
        report(sum(each.num_episodes for each in parts), num_episodes)
    return concatenate(parts)


def make_repeatable(task: str, robot: AnyRobot, **options: Any) -> Env:
    """Call `envs.make`; the backend defaults to jax, since Warp's order of addition varies."""
    options.setdefault("backend", "jax")
    return make(task, robot, **options)


def gather(
    env: Env,
    num_episodes: int,
    key: jax.Array,
    action_noise: float = 0.0,
    ranges: Randomization | None = None,
    *,
    collected: int = 0,
    attempted: int = 0,
) -> Iterator[Episodes]:
    """Yield the successful episodes of each call of `record_expert`, `num_episodes` in total.

    Args:
        env: W worlds, one attempt each per call.
        num_episodes, key, action_noise, ranges: as in `collect`.
        collected, attempted: episodes yielded and attempts made before an interruption; resuming
            with them gives the same episodes as an uninterrupted run.

    Raises:
        ValueError: the expert fails too often.
    """
    ranges = prepare(ranges, env.control_dt)
    if checks.number("action_noise", action_noise) < 0:
        raise ValueError(f"action_noise must be at least 0, got {action_noise}")
    for _ in range(attempted // env.num_envs):
        key, _ = jax.random.split(key)
    tried = 0  # attempts since the last yield
    while collected < num_episodes:
        _check_success(env, collected, attempted)
        key, chunk_key = jax.random.split(key)
        # Wait here without holding the GIL, so that other threads can write their episodes.
        chunk, success = jax.block_until_ready(record_expert(env, chunk_key, action_noise, ranges))
        wins = np.flatnonzero(success)[: num_episodes - collected]
        collected += len(wins)
        # Do not count attempts after the last one needed.
        tries = env.num_envs if collected < num_episodes else int(wins[-1]) + 1
        attempted, tried = attempted + tries, tried + tries
        if len(wins):
            # To host memory: on the device, training needs the space.
            won = jax.tree.map(lambda x, wins=wins: np.asarray(x)[wins], chunk)
            yield Episodes(
                **won,
                instructions=env.instructions,
                task=env.task.name,
                robot=env.robot.name,
                control_dt=env.control_dt,
                physics_dt=env.physics_dt,
                attempted=tried,
                actions=env.actions,
            )
            tried = 0


def _check_success(env: Env, collected: int, attempted: int) -> None:
    if attempted >= _MIN_ATTEMPTS and collected < _MIN_SUCCESS * attempted:
        raise ValueError(
            f"the expert solved only {collected} of {attempted} layouts of {env.task.name!r} with "
            f"{env.robot.name!r}, but must solve {_MIN_SUCCESS:.0%}: check the scene or lower "
            "action_noise"
        )


@traced.cached
def record_expert(
    env: Env, key: jax.Array, action_noise: float | jax.Array, ranges: Randomization | None
) -> tuple[dict[str, Any], jax.Array]:
    """Attempt an episode in every world; return the arrays of `Episodes`, and success `[W]`."""
    first, poses, episodes, success = rollout(env, key, action_noise, ranges)
    worlds, steps = episodes["action"].shape[:2]
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), poses)
    drawn = jax.tree.map(lambda x: jnp.repeat(x, steps, axis=0), first.info["draw"])
    images = env.render(flat, draw=drawn)
    image = {k: x.reshape(worlds, steps, *x.shape[1:]) for k, x in images.items()}
    return {"image": image} | episodes, success


def worlds(num_episodes: int, num_envs: int | None) -> int:
    """Return the number of worlds to simulate at once: `num_envs`, or a default for the device."""
    num_episodes = checks.count("num_episodes", num_episodes, _MAX_EPISODES)
    if num_envs is not None:
        return num_envs
    return min(num_episodes, _NUM_ENVS.get(jax.default_backend(), 256))
