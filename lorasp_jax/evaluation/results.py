"""Success of a policy on a task, measured in closed loop."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from envs.env import Env
from envs.physics import physics
from envs.scene.randomization import Draw
from envs.state import Poses
from lorasp_jax.base.intervals import wilson_interval
from lorasp_jax.evaluation import metrics
from lorasp_jax.evaluation.programs import RECORDED_WORLDS, Rollout, make_rollout
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.demonstrations import map_threads


@dataclass(frozen=True)
class Result:
    """Closed-loop success of a policy on one task.

    Attributes:
        success: fraction of successful episodes.
        episodes: number of episodes.
        ci95: 95 % Wilson interval of the success rate.
        outcomes: success of each episode, in the order of the layouts that the key draws.
        steps: mean control steps per episode.
        active_rank: mean active ranks by tower and linear layer, each a list over stacked layers.
        active_rank_histogram: `[R + 1]` int64 per tower, the sum of `metrics.rank_histogram` over
            all policy calls.
        poses: poses of one recorded episode, a successful one if possible; the leading axis is
            time.
        draw: randomized values of that episode; None without ranges.
    """

    success: float
    episodes: int
    ci95: tuple[float, float]
    outcomes: tuple[bool, ...]
    steps: float
    active_rank: dict[str, dict[str, list[float]]]
    active_rank_histogram: dict[str, np.ndarray]
    poses: Poses = dataclasses.field(repr=False)
    draw: Draw | None = dataclasses.field(default=None, repr=False)


def map_rollouts(function: Callable, *arguments: Iterable[Any]) -> list[Any]:
    """Map a function that runs rollouts, in threads; not in Warp, which is not thread-safe."""
    run = map if physics.default_backend() == "warp" else map_threads
    return [*run(function, *arguments)]


def evaluate(
    policy: Policy,
    env: Env,
    key: jax.Array,
    num_episodes: int = 256,
    *,
    rollout: Callable[[Policy, jax.Array], Rollout] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Result:
    """Measure the success rate of `policy` on the task of `env`.

    Args:
        policy: policy for the robot of `env`, with prompts for `env.instructions`.
        env: environment; `num_envs` episodes run in parallel.
        key: PRNG key of the layouts and the sampled actions.
        num_episodes: a multiple of `env.num_envs`.
        rollout: (policy, key) -> `Rollout`, such as `make_rollout(env)` with other settings;
            None: the default settings.
        progress: called with (completed, total) episodes.

    Raises:
        ValueError: `num_episodes` is not a positive multiple of `env.num_envs`, or the policy has
            no prompt for one of the instructions.
    """
    batches, rest = divmod(num_episodes, env.num_envs)
    if rest or batches < 1:
        raise ValueError(
            f"num_episodes must be a positive multiple of {env.num_envs}, got {num_episodes}"
        )
    rollout = rollout or make_rollout(env)
    runs: list[Rollout] = []
    for batch_key in jax.random.split(key, batches):
        runs.append(jax.block_until_ready(rollout(policy, batch_key)))
        if progress:
            progress(len(runs) * env.num_envs, num_episodes)
    return _result(runs)


def _result(runs: Sequence[Rollout]) -> Result:
    success = np.concatenate([run.success for run in runs])
    successes, episodes = int(success.sum()), len(success)
    world = int(np.argmax(runs[0].success[:RECORDED_WORLDS]))  # the first that succeeds, or 0
    histograms = [run.active_rank_histogram for run in runs]
    return Result(
        success=successes / episodes,
        episodes=episodes,
        ci95=wilson_interval(successes, episodes),
        outcomes=tuple(success.tolist()),
        steps=float(np.mean([run.steps for run in runs])),
        active_rank=jax.tree.map(
            lambda *means: np.mean(means, axis=0).tolist(), *map(_mean_ranks, runs)
        ),
        # int64: token counts over all policy calls can overflow 32 bits.
        active_rank_histogram=jax.tree.map(
            lambda *counts: np.sum(counts, axis=(0, 1), dtype=np.int64), *histograms
        ),
        poses=jax.tree.map(lambda x: x[: max(int(runs[0].steps[world]), 1), world], runs[0].poses),
        draw=jax.tree.map(lambda x: x[world], runs[0].draw),
    )


def _mean_ranks(run: Rollout) -> metrics.LayerRanks:
    """Average active ranks over the policy calls, weighted by the number of unfinished worlds."""
    weights = np.asarray(run.running) / max(np.sum(run.running), 1)
    return jax.tree.map(lambda ranks: np.tensordot(weights, ranks, axes=1), run.active_rank)
