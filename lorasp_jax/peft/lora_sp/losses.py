"""LoRA-SP's auxiliary losses, eqs. (13) and (14) of the paper (arXiv 2603.07404), in fp32.

They are computed from each layer's sums over its tokens, without padding.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.energy_gate import energy_share


class LossSums(NamedTuple):
    """Sums over valid rows: f32 [1], except `active` and `share` [R]."""

    rows: jax.Array
    """Number of valid rows."""
    spectral: jax.Array
    """1 - E_k."""
    z: jax.Array
    """(logsumexp(logits) - ln n)² for n logits."""
    active: jax.Array
    """1 for each active direction, else 0; no gradient."""
    share: jax.Array
    """Each direction's share of the energy."""


def loss_sums(
    scores: jax.Array, logits: jax.Array, mask: jax.Array, kept_energy: jax.Array, valid: jax.Array
) -> LossSums:
    """Sum eqs. (13) and (14) over T rows.

    Scores and mask are [T, R], logits [T, n], kept energy and valid [T, 1].

    Rows with all-zero scores are excluded: they carry no signal for the router. NaN propagates.
    """
    valid = (scores.max(-1, keepdims=True) != 0) & valid
    log_mean_exp = jax.nn.logsumexp(logits, axis=-1, keepdims=True) - math.log(logits.shape[-1])

    def total(values: jax.Array) -> jax.Array:
        return jnp.where(valid, values, 0).sum(0)

    return LossSums(
        rows=total(jnp.ones_like(kept_energy)),
        spectral=total(1 - kept_energy),
        z=total(jnp.square(log_mean_exp)),
        active=total(mask.astype(jnp.float32)),
        share=total(energy_share(scores)),
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Losses(Mapping[str, jax.Array]):
    """The auxiliary losses of eqs. (13) and (14) by name: f32 [], or [L] for stacked layers.

    They are computed on access, once for all stacked layers, rather than as a dozen tiny operations
    in each layer.
    """

    sums: LossSums
    """With a leading axis [L, ...] for stacked layers."""

    def __getitem__(self, name: str) -> jax.Array:
        return _LOSSES[name](self.sums)

    def __iter__(self) -> Iterator[str]:
        return iter(_LOSSES)

    def __len__(self) -> int:
        return len(_LOSSES)


@jax.jit
def spectral_loss(sums: LossSums) -> jax.Array:
    """Eq. (13): 1 - E_k, averaged over valid rows."""
    return _mean(sums.spectral, sums)


@jax.jit
def balance_loss(sums: LossSums) -> jax.Array:
    """Balance term of eq. (14): R Σ_i f_i P_i, which is 1 if all directions are used equally.

    It is the load-balancing loss of Fedus et al. (arXiv 2101.03961, eq. 4) for k(x) choices per
    token. f_i is direction i's share of all active directions (no gradient), and P_i is its mean
    energy share.
    """
    active = jax.lax.stop_gradient(sums.active)
    frequency = active / jnp.maximum(active.sum(-1, keepdims=True), 1)
    return active.shape[-1] * _mean(jnp.sum(frequency * sums.share, -1, keepdims=True), sums)


@jax.jit
def z_loss(sums: LossSums) -> jax.Array:
    """z term of eq. (14): mean of (logsumexp(logits) - ln n)² over valid rows, for n logits.

    Without ln n, as in Zoph et al. (arXiv 2202.08906, eq. 5), the loss of a wide router would push
    down even zero logits.
    """
    return _mean(sums.z, sums)


_LOSSES = {"spectral": spectral_loss, "balance": balance_loss, "z": z_loss}


def _mean(total: jax.Array, sums: LossSums) -> jax.Array:
    return total[..., 0] / jnp.maximum(sums.rows[..., 0], 1)
