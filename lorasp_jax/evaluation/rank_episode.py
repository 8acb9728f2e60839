"""Play an episode of a run's policy and record active ranks at every control step."""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.env import Env
from envs.scene.randomization import Draw
from envs.state import Poses
from lorasp_jax.base import fast_cpu, messages
from lorasp_jax.evaluation import metrics
from lorasp_jax.evaluation.programs import RECORDED_WORLDS
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import RawObservation
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run_folder import recorded_ranges


@dataclass(frozen=True)
class RankEpisode:
    """An episode of T control steps in one world.

    The policy runs at every step, so that ranks belong to the images shown; as in evaluation, the
    robot executes `execute_steps` actions of a chunk and ignores the chunks in between.

    Attributes:
        instruction: what the policy was told.
        success: whether the episode succeeded.
        poses: poses before each step, leading axis T.
        patches: robot camera -> `[T, P, P]`, see `patch_ranks`.
        towers: tower -> `[T]` active rank, averaged over layers and tokens.
        draw: randomized values of the world; None if the run was not randomized.
    """

    instruction: str
    success: bool
    poses: Poses
    patches: dict[str, np.ndarray]
    towers: dict[str, np.ndarray]
    draw: Draw | None = None


def record(policy: Policy, env: Env, config: Mapping[str, Any]) -> RankEpisode:
    """Record the first successful episode of a few, or else the first one.

    Args:
        policy: the run's policy, with a sampler.
        env: the task's environment with one world.
        config: the run's config, as JSON values.

    Raises:
        ValueError: the policy has no prompt for one of the task's instructions.
    """
    key = RandomStream.FINAL_EVALUATION.key(config["seed"], env.task.name)
    episodes = (play(policy, env, config, k) for k in jax.random.split(key, RECORDED_WORLDS))
    first = next(episodes)
    return next((e for e in itertools.chain([first], episodes) if e.success), first)


def play(policy: Policy, env: Env, config: Mapping[str, Any], key: jax.Array) -> RankEpisode:
    """Play one episode; `key` determines its layout and the policy's noise."""
    settings, (reset_key, sample_key) = config["evaluation"], jax.random.split(key)
    state = env.reset(reset_key, recorded_ranges(config))
    instruction = int(state.info["instruction"][0])
    row = jnp.array(policy.processor.prompts.rows(env.instructions)[[instruction]])
    draw = jax.tree.map(lambda x: x[0], state.info["draw"])
    steps, chunk = [], jnp.empty(0)
    while not state.done[0]:
        call, index = divmod(len(steps), settings["execute_steps"])
        arguments = policy, jax.random.fold_in(sample_key, call), env.observe(state), row
        with messages.announce("the policy"):
            actions, *ranks = _sample(*arguments, denoise_steps=settings["denoise_steps"])
        steps.append(jax.tree.map(np.asarray, (Poses.of(state.data), *ranks)))
        chunk = chunk if index else actions
        state = env.step(state, chunk[:, index])
    poses, patches, towers = jax.tree.map(lambda *x: np.stack(x), *steps)
    poses = jax.tree.map(lambda x: x[:, 0], poses)
    success = bool(state.info["success"][0])
    return RankEpisode(env.instructions[instruction], success, poses, patches, towers, draw)


def sample(
    policy: Policy, key: jax.Array, observation: RawObservation, row: jax.Array, denoise_steps: int
) -> tuple[jax.Array, dict[str, jax.Array], dict[str, jax.Array]]:
    """Return actions `[1, C, J+1]`, the ranks of the patches, and the mean rank of each tower."""
    actions, aux = policy.sample(key, observation, row, num_steps=denoise_steps, return_aux=True)
    layers = metrics.layer_ranks(aux, jnp.ones(1, bool))
    towers = {
        tower: jnp.concatenate([*linears.values()]).mean()
        for tower, linears in layers.items()
        if linears
    }
    return actions, patch_ranks(aux, policy), towers


_sample = fast_cpu.jit_policy(sample, static_argnames="denoise_steps")


def patch_ranks(aux: metrics.Reports, policy: Policy) -> dict[str, jax.Array]:
    """Return the active rank of each image patch, averaged over the vision tower's linear layers.

    Tokens are in row-major order, camera after camera in the backbone's order. Simulated images are
    square, hence scaled to the backbone's size without padding. After the pixel shuffle, one token
    stands for a square of patches, which all get its rank.

    Args:
        aux: from one policy call for one observation.
        policy: the policy.

    Returns:
        robot camera -> `[P, P]`, with P patches per side.
    """
    config = policy.model.config
    side, maps = config.image_size // config.vision.patch, []
    for linear in aux["vision"].values():
        if linear.active_rank is not None:
            tokens = math.isqrt(linear.active_rank.shape[-1])
            grid = linear.active_rank.reshape(-1, len(config.cameras), tokens, tokens)
            maps.append(grid.repeat(side // tokens, axis=2).repeat(side // tokens, axis=3))
    mean = jnp.concatenate(maps).mean(0)
    sources = dict(policy.processor.cameras) or {name: name for name in config.cameras}
    found = {sources[slot]: mean[i] for i, slot in enumerate(config.cameras)}
    return {camera: ranks for camera, ranks in found.items() if camera}
