"""LoRA-SP's auxiliary losses, eqs. (13) and (14) of the paper (arXiv 2603.07404), in fp32.

A layer sums over its valid tokens what they need; padding stays out.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.energy_gate import energy_share


class LossSums(NamedTuple):
    """What the auxiliary losses need, summed over the valid rows: f32 [1], kept and share [R]."""

    rows: jax.Array
    spectral: jax.Array
    """1 - E_k."""
    z: jax.Array
    """Squared mean logit, on the scale of exponentials."""
    kept: jax.Array
    """1 for each kept direction; no gradient."""
    share: jax.Array
    """Share of the energy."""


def loss_sums(
    scores: jax.Array, logits: jax.Array, mask: jax.Array, energy: jax.Array, counts: jax.Array
) -> LossSums:
    """The sums for scores and mask [n, R], logits [n, :], kept energy and counts [n, 1].

    A row of zeros is not valid: it teaches the router nothing. NaN shows in the sums.
    """
    valid = (scores.max(-1, keepdims=True) != 0) & counts
    mean_logit = jax.nn.logsumexp(logits, axis=-1, keepdims=True) - math.log(logits.shape[-1])

    def total(values: jax.Array) -> jax.Array:
        return jnp.where(valid, values, 0).sum(0)

    return LossSums(
        rows=total(jnp.ones_like(energy)),
        spectral=total(1 - energy),
        z=total(jnp.square(mean_logit)),
        kept=total(mask.astype(jnp.float32)),
        share=total(energy_share(scores)),
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Losses(Mapping[str, jax.Array]):
    """The auxiliary losses of eq. (14) by name, f32, of one layer or of several, [L].

    They are computed where they are asked for: of stacked layers all at once, not in each layer in
    a dozen steps on a few numbers.
    """

    sums: LossSums
    """[L, ...] for several layers."""

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
    """Balance term of eq. (14): R Σ_i f_i P_i, 1 where all directions are used alike.

    The load-balancing loss of Fedus et al. (arXiv 2101.03961, eq. 4) for k(x) choices a token: f_i
    is direction i's share of all kept places (no gradient), P_i its mean share of the energy.
    """
    kept = jax.lax.stop_gradient(sums.kept)
    used = kept / jnp.maximum(kept.sum(-1, keepdims=True), 1)
    return kept.shape[-1] * _mean(jnp.sum(used * sums.share, -1, keepdims=True), sums)


@jax.jit
def z_loss(sums: LossSums) -> jax.Array:
    """z term of eq. (14): (logsumexp(logits) - ln n)², n = logits' width, over valid rows.

    Zoph et al. (arXiv 2202.08906, eq. 5) without the ln n, which would push the logits of a wide
    router down even where they are all zero.
    """
    return _mean(sums.z, sums)


_LOSSES = {"spectral": spectral_loss, "balance": balance_loss, "z": z_loss}


def _mean(total: jax.Array, sums: LossSums) -> jax.Array:
    return total[..., 0] / jnp.maximum(sums.rows[..., 0], 1)
