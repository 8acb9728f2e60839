"""Checks of success rates, and statistics of active ranks in one policy call."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.policies.policy import ModelAux

Reports = ModelAux
"""Tower -> name of a linear layer -> `Aux` of its adapters, `[..., W, T]`.

W is the number of worlds, times the images of each in the vision tower. T is the number of tokens.
Stacked layers have a layer axis before W. In the action expert, denoising steps come first."""

_MAX_POSITION_Z = 6.0
"""Largest difference in standard deviations that passes for chance; see `position_bias`."""

LayerRanks = dict[str, dict[str, jax.Array]]
"""Tower -> name of a linear layer -> active rank `[L]`; L = 1 for a layer that is not stacked."""


def position_bias(outcomes: Iterable[Sequence[bool]]) -> str:
    """Say whether success depends on the position of an episode in its batch; "" if not.

    Layouts are drawn independently, so it depends on it only if the device computes some rows of a
    batch wrongly. XLA compiled such a program for an H200 (JAX 0.11.2, LoRA-MoE on SmolVLA, 256
    worlds): most episodes failed whose index was not a multiple of four.

    The test compares, for each bit of the index, the episodes with and without it, pooled over
    tasks. By chance, a bit exceeds six standard deviations in 2 of 10⁹ evaluations.

    Args:
        outcomes: success by index, for each task.
    """
    tasks = [np.asarray(success) for success in outcomes]
    for bit in range(max(map(len, tasks), default=0).bit_length()):
        difference = variance = 0.0
        for success in tasks:
            is_set = (np.arange(len(success)) >> bit) % 2 == 1
            if is_set.any() and not is_set.all():
                difference += success[is_set].mean() - success[~is_set].mean()
                variance += success.var() * (1 / is_set.sum() + 1 / (~is_set).sum())
        if abs(difference) > _MAX_POSITION_Z * math.sqrt(variance):
            return (
                f"success depends on bit {bit} of an episode's index, so this device computes some "
                "rows of a batch wrongly: use another evaluation.num_envs or version of JAX"
            )
    return ""


def layer_ranks(reports: Reports, running: jax.Array) -> LayerRanks:
    """Average each layer's active rank over valid tokens, running worlds and denoising steps.

    Args:
        reports: from one policy call; linear layers that report no active rank are omitted.
        running: `[W]` bool, unfinished worlds.
    """

    def mean(rank: jax.Array, valid: jax.Array) -> jax.Array:
        total = jnp.where(valid, rank, 0.0).sum((-2, -1))
        return total / jnp.maximum(valid.sum((-2, -1)), 1)

    ranks = {
        tower: {name: mean(rank, valid) for name, (rank, valid) in linears.items()}
        for tower, linears in _tokens(reports, running).items()
    }
    if "action" in ranks:
        ranks["action"] = {name: rank.mean(0) for name, rank in ranks["action"].items()}
    return jax.tree.map(jnp.atleast_1d, ranks)


def rank_histogram(reports: Reports, running: jax.Array, rank: int) -> dict[str, jax.Array]:
    """Count active ranks per tower, over valid tokens, running worlds, layers and denoising steps.

    Args:
        reports: from one policy call; towers that report no active rank are omitted.
        running: `[W]` bool, unfinished worlds.
        rank: R, the highest possible active rank.

    Returns:
        `[R + 1]` int32 per tower; entry k counts the tokens with active rank k, in each layer
        and denoising step.
    """

    def count(active: jax.Array, valid: jax.Array) -> jax.Array:
        weights = valid.ravel().astype(jnp.int32)
        return jnp.bincount(active.ravel().astype(jnp.int32), weights, length=rank + 1)

    return {
        tower: jnp.stack([count(*tokens) for tokens in linears.values()]).sum(0)
        for tower, linears in _tokens(reports, running).items()
        if linears
    }


def _tokens(
    reports: Reports, running: jax.Array
) -> dict[str, dict[str, tuple[jax.Array, jax.Array]]]:
    """Return active rank and validity, both `[..., W, T]`, of each layer that has a rank."""

    def by_world(linear: Any) -> tuple[jax.Array, jax.Array]:
        rank, mask = linear.active_rank, linear.token_mask
        assert rank is not None
        assert mask is not None  # backbones always set it
        shape = (*rank.shape[:-2], running.shape[0], -1)
        valid = running[:, None] & jnp.broadcast_to(mask, rank.shape).reshape(shape)
        return rank.reshape(shape), valid

    return {
        tower: {name: by_world(a) for name, a in linears.items() if a.active_rank is not None}
        for tower, linears in reports.items()
    }
