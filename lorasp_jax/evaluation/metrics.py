"""Success rates with intervals; active ranks of one look of a policy."""

import math

import jax
import jax.numpy as jnp

from lorasp_jax.peft import Aux

Reports = dict[str, dict[str, Aux]]
"""Tower -> linear map -> what its adapters report, `[..., W, T]`.

Several pictures of a world are folded into W; leading axes are layers, and before them, in the
action expert, denoising steps."""

LayerRanks = dict[str, dict[str, jax.Array]]
"""Tower -> linear map -> active rank `[L]`."""


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson score interval of a success rate (Wilson 1927, J. Am. Stat. Assoc. 22, 209-212).

    Args:
        successes: number of successful trials.
        trials: number of trials, at least 1.
        z: normal quantile; the default gives 95 %.

    Returns:
        Lower and upper bound of the rate.

    Raises:
        ValueError: `trials` is not positive or `successes` lies outside 0..`trials`.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"{successes} successes in {trials} trials is not a success rate")
    rate = successes / trials
    spread = z * math.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2))
    centre = rate + z**2 / (2 * trials)
    scale = 1 + z**2 / trials
    return max((centre - spread) / scale, 0.0), min((centre + spread) / scale, 1.0)


def layer_ranks(reports: Reports, running: jax.Array) -> LayerRanks:
    """Active rank of every layer: mean over valid tokens, running worlds and denoising steps.

    Args:
        reports: of one look; linear maps without a rank are left out.
        running: `[W]` bool, the worlds that count.
    """

    def mean(rank: jax.Array, valid: jax.Array) -> jax.Array:
        total = jnp.where(valid, rank, 0.0).sum((-2, -1))
        return total / jnp.maximum(valid.sum((-2, -1)), 1)

    found = {
        tower: {name: mean(rank, valid) for name, (rank, valid) in linears.items()}
        for tower, linears in _tokens(reports, running).items()
    }
    if "action" in found:
        found["action"] = {name: rank.mean(0) for name, rank in found["action"].items()}
    return jax.tree.map(jnp.atleast_1d, found)


def rank_histogram(reports: Reports, running: jax.Array, rank: int) -> dict[str, jax.Array]:
    """How many tokens of a tower had which active rank, over its layers and linear maps.

    Args:
        reports: of one look; towers without a rank are left out.
        running: `[W]` bool, the worlds that count.
        rank: R, the largest active rank there can be.

    Returns:
        `[R + 1]` int32 by tower, entry k for an active rank of k.
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
    """Active rank and whether it counts, `[..., W, T]` each, of the linear maps that have one."""

    def worlds(linear: Aux) -> tuple[jax.Array, jax.Array]:
        rank, mask = linear.active_rank, linear.token_mask
        assert rank is not None
        assert mask is not None  # the backbones always say which tokens count
        shape = (*rank.shape[:-2], running.shape[0], -1)
        valid = running[:, None] & jnp.broadcast_to(mask, rank.shape).reshape(shape)
        return rank.reshape(shape), valid

    return {
        tower: {name: worlds(a) for name, a in linears.items() if a.active_rank is not None}
        for tower, linears in reports.items()
    }
