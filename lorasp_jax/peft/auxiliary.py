"""Auxiliary outputs of adapted layers, and their averages over valid tokens."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from lorasp_jax.peft.fields import short

AUXILIARY_WEIGHTS: Mapping[str, float] = {
    "spectral": 1e-2,
    "balance": 1e-3,
    "z": 1e-3,
    "orthogonality": 0.1,
}
"""Default weight of each auxiliary loss, eq. 14 of the LoRA-SP paper; AdaLoRA's orthogonality is
eq. 4 of arXiv 2303.10512."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Aux:
    """Auxiliary outputs of an adapted layer.

    Attributes:
        active_rank: f32 [...tokens], number of active directions; None if the method has no rank.
        kept_energy: f32 [...tokens], the active directions' fraction of the score energy: E_k of
            eq. (12) of the LoRA-SP paper. None for methods without an energy gate.
        losses: f32 [] by name, or [L] for stacked layers, averaged over the valid tokens.
        token_mask: bool [...tokens], True for valid tokens; None if all are valid.
        usage: f32 [R], number of valid tokens that use each direction; None without an energy gate.
        statistics: sums over valid tokens, by layer path; empty except during calibration
            (`lorasp_jax.adapters.compress.calibration`).
    """

    active_rank: jax.Array | None = None
    kept_energy: jax.Array | None = None
    losses: Mapping[str, jax.Array] = dataclasses.field(default_factory=dict)
    token_mask: jax.Array | None = None
    usage: jax.Array | None = None
    statistics: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def mean_active_rank(self) -> jax.Array | None:
        """Active rank averaged over valid tokens (and over layers, if stacked), an f32 scalar."""
        if self.active_rank is None:
            return None
        return masked_mean(self.active_rank, self.token_mask)


def masked_mean(values: jax.Array, mask: jax.Array | None) -> jax.Array:
    """Mean of values [...] over the positions where mask [...] is True; 0 if there are none."""
    if mask is None:
        return values.mean() if values.size else jnp.zeros((), values.dtype)
    return jnp.where(mask, values, 0).sum() / jnp.maximum(mask.sum(), 1)


def auxiliary_losses(aux: Any) -> dict[str, jax.Array]:
    """Average each auxiliary loss, such as eqs. (13) and (14) of LoRA-SP, over adapted layers.

    The means are f32 [], by name, over the layers that have the loss.

    Args:
        aux: any tree of `Aux`, such as the result of `collect_aux`. An `Aux` stacked by a scan
            counts once per layer.

    Raises:
        ValueError: a leaf of the tree is not an `Aux`.
    """
    layers = jax.tree.leaves(aux, is_leaf=lambda node: isinstance(node, Aux))
    if invalid := [layer for layer in layers if not isinstance(layer, Aux)]:
        raise ValueError(
            f"aux must be a tree of Aux such as collect_aux returns, got {short(invalid[0])}"
        )
    names = sorted({name for layer in layers for name in layer.losses})
    return {
        name: jnp.concatenate(
            [jnp.ravel(layer.losses[name]) for layer in layers if name in layer.losses]
        ).mean()
        for name in names
    }
