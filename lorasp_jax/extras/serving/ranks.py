"""The mean active rank of a policy call, of each of its rows."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from lorasp_jax.policies.policy import ModelAux


class Ranks(NamedTuple):
    """Active ranks of layers with an energy gate: f32 `[..., B]`, summed over as many layers."""

    total: jax.Array
    layers: jax.Array | int


def summed(aux: ModelAux, rows: int) -> Ranks | None:
    """Average active ranks over each row's valid tokens, and sum them over layers.

    Args:
        aux: of one evaluation, `[..., W, T]`; W is a multiple of the rows, such as their images.
        rows: B, number of observations.

    Returns:
        None if no layer has an energy gate.
    """
    totals, layers = [], 0
    for linear in (each for tower in aux.values() for each in tower.values()):
        rank, mask = linear.active_rank, linear.token_mask
        if linear.kept_energy is None or rank is None:
            continue
        assert mask is not None  # backbones always set it
        count, mask = math.prod(rank.shape[:-2]), jnp.broadcast_to(mask, rank.shape)
        valid, rank = (x.reshape(count, rows, -1) for x in (mask, rank))
        totals.append((jnp.where(valid, rank, 0).sum(-1) / jnp.maximum(valid.sum(-1), 1)).sum(0))
        layers += count
    return Ranks(jnp.stack(totals).sum(0), layers) if totals else None


def mean(prefix: Ranks | None, steps: Ranks | None) -> jax.Array | None:
    """Return the mean `[B]` over all layers, as results.json has it; None if there are none.

    Args:
        prefix: of what a call evaluates once.
        steps: of what it evaluates in each flow step, with a leading step axis.
    """
    each = Ranks(steps.total.mean(0), jnp.asarray(steps.layers)[0]) if steps else None
    if not (known := [ranks for ranks in (prefix, each) if ranks]):
        return None
    return jnp.stack([r.total for r in known]).sum(0) / sum(r.layers for r in known)
