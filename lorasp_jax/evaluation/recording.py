"""Record a policy's own episodes in simulation, with their outcomes, to learn from them."""

import functools
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from envs.datasets.episodes import Episodes
from envs.datasets.rlds import ShardWriter
from envs.env import Env
from envs.scene.ranges import Randomization
from lorasp_jax.base.locks import locked
from lorasp_jax.base.writing import atomic_folder
from lorasp_jax.config import Config
from lorasp_jax.evaluation.programs import Worlds, environment
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.random_streams import RandomStream


def record(
    policy: Policy,
    env: Env,
    key: jax.Array,
    *,
    execute_steps: int = 5,
    denoise_steps: int,
    ranges: Randomization | None = None,
) -> Episodes:
    """Run an episode in every world and return all of them, labelled, in host memory.

    Unlike in evaluation, which renders what the policy looks at alone, every control step is
    rendered. Actions are the executed ones, within the robot's limits.

    Args:
        policy: policy for the robot of `env`, with prompts for `env.instructions`.
        env: the worlds.
        key: determines the layouts and the policy's noise.
        execute_steps: actions executed of each chunk.
        denoise_steps: Euler steps of the flow-matching sampler.
        ranges: of `env.reset`.

    Raises:
        ValueError: the policy has no prompt for one of the instructions.
    """
    worlds, steps, alive = Worlds(env, policy, key, ranges), [], []
    instruction = np.asarray(worlds.state.info["instruction"])
    while not (done := np.asarray(worlds.state.done)).all():
        call, index = divmod(len(steps), execute_steps)
        if not index:
            chunk, _ = worlds.predict(call, denoise_steps=denoise_steps)
        action = chunk[:, index : index + 1]
        seen = jax.device_get({**worlds.observe(), "action": action[:, 0]})
        steps.append(jax.tree.map(functools.partial(_without, done), seen))
        alive.append(~done)
        worlds.act(action, 1)
    stacked = jax.tree.map(lambda *arrays: np.stack(arrays, axis=1), *steps)
    return Episodes(
        image=stacked["image"],
        state=stacked["state"],
        action=np.clip(stacked["action"], env.action_low, env.action_high),
        length=np.stack(alive).sum(axis=0, dtype=np.int32),
        instruction=instruction,
        instructions=env.instructions,
        task=env.task.name,
        robot=env.robot.name,
        control_dt=env.control_dt,
        physics_dt=env.physics_dt,
        attempted=env.num_envs,
        actions=env.actions,
        success=np.asarray(worlds.state.info["success"], np.int32),
    )


def _without(done: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values `[W, ...]`, zero in the worlds that are done."""
    return np.where(done.reshape(-1, *[1] * (values.ndim - 1)), np.zeros_like(values), values)


def write(
    policy: Policy,
    config: Config,
    task: str,
    folder: Path,
    num_episodes: int,
    *,
    seed: int,
    progress: Callable[[int], object],
) -> int:
    """Record episodes of a run's policy as an RLDS dataset; return the number of successes.

    Args:
        policy: the run's policy.
        config: the run's config, which says how it is executed.
        task: one of its tasks.
        folder: folder to create.
        num_episodes: number of episodes; of all in which worlds run together, the first are kept.
        seed: other seeds give other layouts; none are those that evaluations draw.
        progress: called with the number of episodes that have been added.

    Raises:
        ValueError: the folder already exists.
        OSError: the disk is full.
    """
    settings, wins = config.evaluation, 0
    sizes = min(settings.num_envs, num_episodes), config.image_size, config.control_dt
    env = environment(task, config.robot, *sizes)
    key = RandomStream.RECORDING.key(seed, task)
    steps = {"execute_steps": settings.execute_steps, "denoise_steps": settings.denoise_steps}
    policy = policy.with_sampler()
    with locked(folder), atomic_folder(folder) as unfinished:
        writer = ShardWriter(unfinished, {"seed": seed})
        while (left := num_episodes - writer.num_episodes) > 0:
            key, batch_key = jax.random.split(key)
            episodes = record(policy, env, batch_key, ranges=config.ranges, **steps)
            kept = episodes.select(range(min(left, env.num_envs)))
            writer.append(kept)
            wins += int(np.sum(kept.success == 1))
            progress(kept.num_episodes)
        writer.complete()
    return wins
