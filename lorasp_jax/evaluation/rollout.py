"""Closed-loop rollouts in one jit: observe, predict a chunk, execute part of it, repeat."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs.compilation import fast_cpu
from envs.env import Env
from envs.scene.randomization import Randomization
from envs.state import Poses, State
from lorasp_jax.config import Config
from lorasp_jax.evaluation import metrics
from lorasp_jax.policies.policy import Policy

RECORDED_WORLDS = 8
"""Number of worlds whose poses are recorded; one of them becomes the video."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rollout:
    """One batch of episodes.

    Attributes:
        success: `[W]` bool.
        steps: `[W]` int32, control steps up to success or the time limit.
        active_rank: `[L]` per linear layer, mean over tokens, policy calls and unfinished worlds.
        active_rank_histogram: `[calls, R + 1]` int32 per tower; see `metrics.rank_histogram`. R is
            the largest adapter rank.
        poses: poses of the first worlds at every control step, leading axes `[time, worlds]`.
    """

    success: jax.Array
    steps: jax.Array
    active_rank: metrics.LayerRanks
    active_rank_histogram: dict[str, jax.Array]
    poses: Poses


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
    """

    success: float
    episodes: int
    ci95: tuple[float, float]
    outcomes: tuple[bool, ...]
    steps: float
    active_rank: dict[str, dict[str, list[float]]]
    active_rank_histogram: dict[str, np.ndarray]
    poses: Poses = dataclasses.field(repr=False)


def make_rollout(
    env: Env,
    *,
    execute_steps: int = 5,
    denoise_steps: int = 10,
    ranges: Randomization | None = None,
) -> Callable[[Policy, jax.Array], Rollout]:
    """Create a pure function (policy, key) that runs `env.num_envs` episodes, to be jitted.

    Every `execute_steps` control steps, the policy observes and samples a new chunk in
    `denoise_steps` Euler steps. `ranges` is passed to `env.reset`; its colors are not recorded.
    """
    num_calls = -(-env.max_steps // execute_steps)

    def rollout(policy: Policy, key: jax.Array) -> Rollout:
        chunk = policy.model.config.chunk
        if not 1 <= execute_steps <= chunk:
            raise ValueError(
                f"execute_steps must be from 1 to the chunk length ({chunk}), got {execute_steps}"
            )
        reset_key, sample_key = jax.random.split(key)
        policy = policy.with_sampler()
        block = functools.partial(_control_block, env, policy, execute_steps, denoise_steps)
        state, (poses, ranks, histogram, running) = jax.lax.scan(
            block, env.reset(reset_key, ranges), jax.random.split(sample_key, num_calls)
        )
        weights = running / jnp.maximum(running.sum(), 1)
        mean = functools.partial(jnp.tensordot, weights, axes=1, precision="highest")
        return Rollout(
            success=state.info["success"],
            steps=state.info["steps"],
            active_rank=jax.tree.map(mean, ranks),
            active_rank_histogram=histogram,
            poses=jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), poses),
        )

    return rollout


def compiled_rollout(
    config: Config, task: str
) -> tuple[Env, Callable[[Policy, jax.Array], Rollout]]:
    """Create the environment of a task and its jitted rollout."""
    env = envs.make(
        task,
        robot=config.robot,
        num_envs=config.evaluation.worlds,
        image_size=config.image_size,
        control_dt=config.control_dt,
    )
    rollout = make_rollout(
        env,
        execute_steps=config.evaluation.execute_steps,
        denoise_steps=config.evaluation.denoise_steps,
    )
    return env, jax.jit(rollout)


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
        rollout: a jitted `make_rollout(env)` to share between calls so that it compiles only once;
            None creates one.
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
    policy = _with_prompts(policy, env)
    rollout = rollout or fast_cpu.jit(make_rollout(env))
    runs: list[Rollout] = []
    for batch_key in jax.random.split(key, batches):
        runs.append(jax.block_until_ready(rollout(policy, batch_key)))
        if progress:
            progress(len(runs) * env.num_envs, num_episodes)
    return _result(runs)


def _control_block(
    env: Env, policy: Policy, execute_steps: int, denoise_steps: int, state: State, key: jax.Array
) -> tuple[State, tuple]:
    """Observe, predict a chunk and execute it; return the next state and the records."""
    actions, aux = policy.sample(
        key, env.observe(state), state.info["instruction"], num_steps=denoise_steps, return_aux=True
    )
    running = ~state.done
    ranks = metrics.layer_ranks(aux, running)
    histogram = metrics.rank_histogram(aux, running, _max_rank(policy))

    def act(state: State, action: jax.Array) -> tuple[State, Poses]:
        state = env.step(state, action)
        return state, jax.tree.map(lambda x: x[:RECORDED_WORLDS], Poses.of(state.data))

    state, poses = jax.lax.scan(act, state, jnp.moveaxis(actions[:, :execute_steps], 1, 0))
    return state, (poses, ranks, histogram, running.sum())


def _max_rank(policy: Policy) -> int:
    """Return the largest adapter rank; 0 if no method has a rank."""
    return max((getattr(method, "rank", 0) for method in policy.model.methods), default=0)


def _result(runs: Sequence[Rollout]) -> Result:
    """Aggregate batches of episodes."""
    success = np.concatenate([run.success for run in runs])
    successes, episodes = int(success.sum()), len(success)
    ranks, histograms = zip(*((r.active_rank, r.active_rank_histogram) for r in runs), strict=True)
    return Result(
        success=successes / episodes,
        episodes=episodes,
        ci95=metrics.wilson_interval(successes, episodes),
        outcomes=tuple(success.tolist()),
        steps=float(np.mean([run.steps for run in runs])),
        active_rank=jax.tree.map(lambda *r: np.mean(r, axis=0).tolist(), *ranks),
        # int64: token counts over all policy calls can overflow 32 bits.
        active_rank_histogram=jax.tree.map(
            lambda *counts: np.sum(counts, axis=(0, 1), dtype=np.int64), *histograms
        ),
        poses=_recorded_episode(runs[0]),
    )


def _with_prompts(policy: Policy, env: Env) -> Policy:
    """Restrict the prompt table to the environment's instructions, in the environment's order."""
    prompts = policy.processor.prompts.select(env.instructions)
    return Policy(policy.model, dataclasses.replace(policy.processor, prompts=prompts))


def _recorded_episode(run: Rollout) -> Poses:
    """Return one episode's poses: of the first recorded world that succeeds, or else of world 0."""
    world = int(jnp.argmax(run.success[:RECORDED_WORLDS]))
    return jax.tree.map(lambda x: x[: max(int(run.steps[world]), 1), world], run.poses)
