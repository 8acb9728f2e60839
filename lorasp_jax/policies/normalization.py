"""Normalize robot states and actions to order one, and unnormalize them.

Every mode is an affine map: y = (x - shift) / divisor + offset and x = (y - offset) factor + shift.

    mean_std             shift mean, spread std, offset 0
    min_max, quantiles   shift low, spread high - low, offset -1: [low, high] becomes [-1, 1];
                         low and high: minimum and maximum in min_max, percentiles 1 and 99
                         in quantiles, 10 and 90 in quantile10
    identity             y = x

Divisor and factor are both the spread, halved for ranges. Before any halving, each convention
guards the spread against zero in constant dimensions:

    ours      at least MIN_SPREAD, in both directions
    openpi    adds 1e-6, in both directions (transforms.py, Normalize and Unnormalize, at 15a9616a)
    lerobot   std: adds 1e-8, only to the divisor; ranges: 1e-8 in place of 0, in both directions
              (processor/normalize_processor.py, 0.6)
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from lorasp_jax.models.inputs import Convention, Mode

MIN_SPREAD = 1e-3
"""Lower bound on the spread [rad, m], so that noise in a constant dimension (such as a gripper that
stays open) is not amplified."""
BOUNDS = {"min_max": ("min", "max"), "quantiles": ("q01", "q99"), "quantile10": ("q10", "q90")}
"""Names of the statistics whose values map to -1 and 1."""
_OPENPI, _LEROBOT = 1e-6, 1e-8


class _AffineMap(NamedTuple):
    shift: jax.Array
    divisor: jax.Array
    factor: jax.Array
    offset: float


def normalize(
    values: jax.Array, stats: Mapping[str, jax.Array], mode: Mode, convention: Convention
) -> jax.Array:
    """Normalize states or actions to `[..., J]` f32.

    Args:
        values: `[..., J]` [rad, m].
        stats: their statistics by name, `[J]` each.
        mode: see the module docstring.
        convention: the project whose guard against small spreads applies.

    Raises:
        ValueError: a statistic that the mode needs is missing.
    """
    values = values.astype(jnp.float32)
    if mode == "identity":
        return values
    affine = _affine_map(stats, mode, convention)
    return (values - affine.shift) / affine.divisor + affine.offset


def unnormalize(
    values: jax.Array, stats: Mapping[str, jax.Array], mode: Mode, convention: Convention
) -> jax.Array:
    """Invert `normalize`: return `[..., J]` f32 [rad, m]."""
    values = values.astype(jnp.float32)
    if mode == "identity":
        return values
    affine = _affine_map(stats, mode, convention)
    return (values - affine.offset) * affine.factor + affine.shift


def _affine_map(stats: Mapping[str, jax.Array], mode: Mode, convention: Convention) -> _AffineMap:
    needed = BOUNDS.get(mode, ("mean", "std"))
    missing = [name for name in needed if name not in stats]
    if missing:
        raise ValueError(
            f"Normalization {mode!r} requires the statistics {', '.join(needed)}, "
            f"got {', '.join(stats) or 'none'}."
        )
    first, second = (stats[name] for name in needed)
    spread = second if mode == "mean_std" else second - first
    if convention == "openpi":
        divisor = factor = spread + _OPENPI
    elif convention == "ours":
        divisor = factor = jnp.maximum(spread, MIN_SPREAD)
    elif mode == "mean_std":
        divisor, factor = spread + _LEROBOT, spread
    else:
        divisor = factor = jnp.where(spread == 0, _LEROBOT, spread)
    half, offset = (1, 0.0) if mode == "mean_std" else (2, -1.0)
    return _AffineMap(first, divisor / half, factor / half, offset)
