"""Policy in the loop: look, predict a chunk, execute part of it, look again - all in one jit."""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from envs.env import Env, State
from lorasp_jax.evaluation.metrics import wilson_interval
from lorasp_jax.models import tokenizer
from lorasp_jax.models.policy import Policy
from lorasp_jax.peft import Aux

FILMED_WORLDS = 8
"""Worlds whose poses are kept, to choose one of them for the video."""

Poses = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
"""Geom positions and rotations, camera positions and rotations: the arguments of `Env.render`."""

Ranks = dict[str, dict[str, jax.Array]]
"""Tower -> linear map -> active rank."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rollout:
    """One batch of episodes.

    Attributes:
        success: `[W]` bool.
        steps: `[W]` int32, control steps until success or the time limit.
        active_rank: `[L]` per linear map, mean over tokens and the looks of worlds not yet done.
        poses: the first worlds at every control step, leading axes `[time, worlds]`.
    """

    success: jax.Array
    steps: jax.Array
    active_rank: Ranks
    poses: Poses


@dataclass(frozen=True)
class Result:
    """Closed-loop success of a policy on one task.

    Attributes:
        success: share of successful episodes.
        episodes: number of episodes.
        ci95: Wilson 95 % interval of the share.
        steps: mean control steps per episode.
        active_rank: one value a layer, per tower and linear map.
        poses: one filmed episode, a successful one if there is any, leading axis time.
    """

    success: float
    episodes: int
    ci95: tuple[float, float]
    steps: float
    active_rank: dict[str, dict[str, list[float]]]
    poses: Poses


def make_rollout(
    env: Env, *, execute_steps: int = 5, denoise_steps: int = 10
) -> Callable[[Policy, jax.Array], Rollout]:
    """The rollout of `env.num_envs` episodes, a pure function of policy and key, ready for jit.

    Every `execute_steps` control steps the policy looks and draws a new chunk with `denoise_steps`
    Euler steps.
    """
    looks = -(-env.max_steps // execute_steps)

    def act(state: State, action: jax.Array) -> tuple[State, Poses]:
        state = env.step(state, action)
        data = state.data
        poses = (data.geom_xpos, data.geom_xmat, data.cam_xpos, data.cam_xmat)
        return state, jax.tree.map(lambda x: x[:FILMED_WORLDS], poses)

    def look(policy: Policy, state: State, key: jax.Array) -> tuple[State, tuple]:
        chunk = policy.model.config.chunk
        if not 1 <= execute_steps <= chunk:
            raise ValueError(f"execute_steps must be 1 to the chunk, {chunk}, got {execute_steps}")
        actions, aux = policy.sample(
            key,
            env.observe(state),
            state.info["instruction"],
            num_steps=denoise_steps,
            return_aux=True,
        )
        running = ~state.done
        state, poses = jax.lax.scan(act, state, jnp.moveaxis(actions[:, :execute_steps], 1, 0))
        return state, (poses, _ranks(aux, running), running.sum())

    def rollout(policy: Policy, key: jax.Array) -> Rollout:
        reset_key, sample_key = jax.random.split(key)
        keys = jax.random.split(sample_key, looks)
        state, (poses, ranks, running) = jax.lax.scan(
            functools.partial(look, policy), env.reset(reset_key), keys
        )
        weights = running / jnp.maximum(running.sum(), 1)
        mean = functools.partial(jnp.tensordot, weights, axes=1, precision="highest")
        return Rollout(
            success=state.info["success"],
            steps=state.info["steps"],
            active_rank=jax.tree.map(mean, ranks),
            poses=jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), poses),
        )

    return rollout


def evaluate(
    policy: Policy,
    env: Env,
    key: jax.Array,
    num_episodes: int = 256,
    *,
    rollout: Callable[[Policy, jax.Array], Rollout] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Result:
    """Success of `policy` on the task of `env` in fresh episodes.

    Args:
        policy: for the robot of `env`; it is told the task in the words of `env.instructions`.
        env: where to evaluate; `num_envs` episodes run at a time.
        key: consumed; the same key gives the same layouts.
        num_episodes: a multiple of `env.num_envs`.
        rollout: jitted `make_rollout(env)`; pass the same one again to compile only once.
        progress: called with episodes done and episodes wanted.

    Raises:
        ValueError: `num_episodes` is not a positive multiple of `env.num_envs`.
    """
    batches, rest = divmod(num_episodes, env.num_envs)
    if rest or batches < 1:
        raise ValueError(
            f"{num_episodes} episodes are not a positive multiple of the {env.num_envs} worlds"
        )
    policy = _told(policy, env)
    rollout = rollout or jax.jit(make_rollout(env))
    runs: list[Rollout] = []
    for batch_key in jax.random.split(key, batches):
        runs.append(jax.block_until_ready(rollout(policy, batch_key)))
        if progress:
            progress(len(runs) * env.num_envs, num_episodes)
    successes = int(sum(run.success.sum() for run in runs))
    return Result(
        success=successes / num_episodes,
        episodes=num_episodes,
        ci95=wilson_interval(successes, num_episodes),
        steps=float(np.mean([run.steps.mean() for run in runs])),
        active_rank=jax.tree.map(
            lambda *ranks: np.mean(ranks, axis=0).tolist(), *(run.active_rank for run in runs)
        ),
        poses=_film(runs[0]),
    )


def _told(policy: Policy, env: Env) -> Policy:
    """The policy with the instructions of one environment in its token table."""
    ids, valid = tokenizer.encode(env.instructions, policy.model.config.max_tokens)
    table = {"tokens": jnp.asarray(ids), "token_mask": jnp.asarray(valid)}
    return Policy(policy.model, dataclasses.replace(policy.processor, **table))


def _film(run: Rollout) -> Poses:
    """The poses of the first filmed world that succeeded, or of world 0, until it was done."""
    world = int(jnp.argmax(run.success[:FILMED_WORLDS]))
    return jax.tree.map(lambda x: x[: max(int(run.steps[world]), 1), world], run.poses)


def _ranks(aux: dict[str, dict[str, Aux]], running: jax.Array) -> Ranks:
    """`[L]` active ranks of one look: mean over valid tokens and running worlds.

    A layer reports `[..., W, T]`, several pictures of a world folded into W; the action expert
    also has a leading axis of denoising steps, over which the mean is taken.
    """

    def reduce(linear: Aux) -> jax.Array:
        rank, mask = linear.active_rank, linear.token_mask
        assert rank is not None
        assert mask is not None  # the backbones always say which tokens count
        worlds = (*rank.shape[:-2], running.shape[0], -1)
        valid = running[:, None] & jnp.broadcast_to(mask, rank.shape).reshape(worlds)
        total = jnp.where(valid, rank.reshape(worlds), 0.0).sum((-2, -1))
        return total / jnp.maximum(valid.sum((-2, -1)), 1)

    found = {
        tower: {name: reduce(a) for name, a in linears.items() if a.active_rank is not None}
        for tower, linears in aux.items()
    }
    if "action" in found:
        found["action"] = {name: rank.mean(0) for name, rank in found["action"].items()}
    return {
        tower: {name: jnp.atleast_1d(rank) for name, rank in ranks.items()}
        for tower, ranks in found.items()
    }
