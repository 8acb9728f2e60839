"""What an adapted layer reports beside its output; padding stays out of everything it averages."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from lorasp_jax.peft._fields import short


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Aux:
    """What an adapted layer reports beside its output.

    Attributes:
      active_rank: f32 [...tokens], directions in use; None where a method has no rank.
      kept_energy: f32 [...tokens], E_k of eq. (12); None without a gate.
      losses: fp32 scalars by name, already averaged over the valid tokens.
      token_mask: bool [...tokens], True where a token counts; None means all do.
      usage: f32 [R], for how many valid tokens each direction was in use; None without a gate.
      statistics: sums over valid tokens by layer path, during calibration
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
    """Each auxiliary loss averaged over the adapted layers that have it, f32 scalars by name.

    Args:
      aux: any tree of `Aux`, such as what `collect_aux` gives. One that a scan over depth stacked
        holds a value of each layer, and counts as so many.

    Raises:
      ValueError: it holds something else.
    """
    layers = jax.tree.leaves(aux, is_leaf=lambda node: isinstance(node, Aux))
    if others := [layer for layer in layers if not isinstance(layer, Aux)]:
        raise ValueError(f"aux must be a tree of Aux, as of collect_aux, got {short(others[0])}.")
    names = sorted({name for layer in layers for name in layer.losses})
    return {
        name: jnp.concatenate(
            [jnp.ravel(layer.losses[name]) for layer in layers if name in layer.losses]
        ).mean()
        for name in names
    }
