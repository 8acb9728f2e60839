"""Closed-loop rollouts in one jit: observe, predict a chunk, execute part of it, repeat."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from envs.env import Env
from envs.scene.randomization import Draw
from envs.scene.ranges import Randomization
from envs.state import Poses, State
from lorasp_jax.evaluation import metrics
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import RawObservation

RECORDED_WORLDS = 8
"""Number of worlds whose poses are recorded; one of them becomes the video."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rollout:
    """One batch of episodes.

    Attributes:
        success: `[W]` bool.
        steps: `[W]` int32, control steps up to success or the time limit.
        running: `[calls]` int32, number of unfinished worlds.
        active_rank: `[calls, L]` per linear layer, mean over tokens and unfinished worlds.
        active_rank_histogram: `[calls, R + 1]` int32 per tower; see `metrics.rank_histogram`. R is
            the largest adapter rank.
        poses: poses of the first worlds at every control step, leading axes `[time, worlds]`.
        draw: randomized values of these worlds, leading axis `[worlds]`; None without ranges.
    """

    success: jax.Array
    steps: jax.Array
    running: jax.Array
    active_rank: metrics.LayerRanks
    active_rank_histogram: dict[str, jax.Array]
    poses: Poses
    draw: Draw | None


def make_rollout(
    env: Env,
    *,
    execute_steps: int = 5,
    denoise_steps: int = 10,
    ranges: Randomization | None = None,
) -> Callable[[Policy, jax.Array], Rollout]:
    """Create a pure function (policy, key) that runs `env.num_envs` episodes, to be jitted.

    Every `execute_steps` control steps, the policy observes and samples a new chunk in
    `denoise_steps` Euler steps. `ranges` is passed to `env.reset`.
    """

    def rollout(policy: Policy, key: jax.Array) -> Rollout:
        calls = num_calls(env, policy, execute_steps)
        rows = policy.processor.prompts.rows(env.instructions)
        reset_key, sample_key = jax.random.split(key)
        policy = policy.with_sampler()

        def block(state: State, call: jax.Array) -> tuple[State, tuple]:
            prompts = jnp.asarray(rows)[state.info["instruction"]]
            inputs = (sample_key, call, env.observe(state), prompts, state.done)
            actions, ranks = predict(policy, *inputs, denoise_steps=denoise_steps)
            state, poses = act(env, state, actions, execute_steps=execute_steps)
            return state, (poses, *ranks)

        state, records = jax.lax.scan(block, env.reset(reset_key, ranges), jnp.arange(calls))
        return as_rollout(state, *records)

    return rollout


def num_calls(env: Env, policy: Policy, execute_steps: int) -> int:
    """Return the number of policy calls per episode.

    Raises:
        ValueError: chunks have fewer than `execute_steps` actions.
    """
    chunk = policy.model.config.chunk
    if not 1 <= execute_steps <= chunk:
        raise ValueError(
            f"execute_steps must be from 1 to the chunk length ({chunk}), got {execute_steps}"
        )
    return -(-env.max_steps // execute_steps)


def predict(
    policy: Policy,
    key: jax.Array,
    call: jax.Array,
    observation: RawObservation,
    prompts: jax.Array,
    done: jax.Array,
    *,
    denoise_steps: int,
    **previous: Any,
) -> tuple[jax.Array, tuple[metrics.LayerRanks, dict[str, jax.Array], jax.Array]]:
    """Sample a chunk in every world, with a new key for each call.

    Args:
        policy: the policy, with a sampler.
        key: key of the rollout.
        call: `[]` int32, index of the policy call.
        observation: from `env.observe`.
        prompts: `[W]` int32, rows of the policy's prompt table.
        done: `[W]` bool.
        denoise_steps: Euler steps.
        previous: `previous`, `prefix_length` and `guidance` of `Policy.sample`, if any.

    Returns:
        `[W, C, J+1]` actions, and (active ranks, their histogram, number of unfinished worlds).
    """
    call_key = jax.random.fold_in(key, call)
    actions, aux = policy.sample(
        call_key, observation, prompts, num_steps=denoise_steps, return_aux=True, **previous
    )
    ranks = metrics.layer_ranks(aux, ~done)
    histogram = metrics.rank_histogram(aux, ~done, _max_rank(policy))
    return actions, (ranks, histogram, jnp.sum(~done))


def act(env: Env, state: State, actions: jax.Array, *, execute_steps: int) -> tuple[State, Poses]:
    """Execute the first actions of chunks `[W, C, J+1]`.

    Returns:
        The state afterwards, and poses of the recorded worlds with leading axes
        `[execute_steps, worlds]`.
    """

    def step(state: State, action: jax.Array) -> tuple[State, Poses]:
        state = env.step(state, action)
        return state, jax.tree.map(lambda x: x[:RECORDED_WORLDS], Poses.of(state.data))

    return jax.lax.scan(step, state, jnp.moveaxis(actions[:, :execute_steps], 1, 0))


def as_rollout(
    state: State,
    poses: Poses,
    ranks: metrics.LayerRanks,
    histogram: dict[str, jax.Array],
    running: jax.Array,
) -> Rollout:
    """Return a rollout from its last state and the records, which have leading axis `[calls]`."""
    return Rollout(
        success=state.info["success"],
        steps=state.info["steps"],
        running=running,
        active_rank=ranks,
        active_rank_histogram=histogram,
        poses=jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), poses),
        draw=jax.tree.map(lambda x: x[:RECORDED_WORLDS], state.info["draw"]),
    )


def _max_rank(policy: Policy) -> int:
    """Return the largest adapter rank; 0 if no method has a rank."""
    return max((getattr(method, "rank", 0) for method in policy.model.methods), default=0)
