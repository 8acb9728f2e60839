"""Normalize robot states and actions to order one, and unnormalize them.

Every mode is an affine map: y = (x - shift) / divisor + offset and x = (y - offset) factor + shift.

    mode         shift   spread      offset
    mean_std     mean    std         0
    min_max      min     max - min   -1
    quantiles    q01     q99 - q01   -1
    quantile10   q10     q90 - q10   -1
    identity     y = x

In `mean_std`, divisor and factor are the spread. In the next three modes they are half the spread,
which maps the two bounds to -1 and 1.

In constant dimensions the spread is 0. Each convention guards the spread, before it is halved:

    ours      at least MIN_SPREAD
    openpi    adds 1e-6 (transforms.py, Normalize and Unnormalize, at 15a9616a)
    lerobot   mean_std: adds 1e-8 to the divisor only
              other modes: replaces 0 by 1e-8 (processor/normalize_processor.py, 0.6)
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
    """Normalize states or actions `[..., J+1]` [rad, m], given their statistics `[J+1]`, to f32.

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
    """Invert `normalize`: return `[..., J+1]` f32 [rad, m]."""
    values = values.astype(jnp.float32)
    if mode == "identity":
        return values
    affine = _affine_map(stats, mode, convention)
    return (values - affine.offset) * affine.factor + affine.shift


def _affine_map(stats: Mapping[str, jax.Array], mode: Mode, convention: Convention) -> _AffineMap:
    needed = BOUNDS.get(mode, ("mean", "std"))
    if not stats.keys() >= {*needed}:
        raise ValueError(f"{mode!r} needs the statistics {needed}, got {[*stats]}")
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
