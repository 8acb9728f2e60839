"""Numbers of a robot to numbers of the order of one, and back.

Every mode is a line: y = (x - shift) / divisor + offset and x = (y - offset) factor + shift.
Divisor and factor are the same spread up to what keeps a constant slot from dividing by zero, and
that is a convention of each project:

    mean_std             shift mean, spread std, offset 0
    min_max, quantiles   shift low, spread (high - low) / 2, offset -1: [low, high] becomes [-1, 1];
                         quantiles are the 1st and the 99th percentile, quantile10 10th and 90th
    identity             y = x

    ours      at least SMALLEST_SPREAD, both ways
    openpi    1e-6 more, both ways (transforms.py, Normalize and Unnormalize, at 15a9616a)
    lerobot   std: 1e-8 more on the way in only; a range: 1e-8 in place of 0, both ways
              (processor/normalize_processor.py, 0.6)
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from lorasp_jax.models.inputs import Convention, Mode

SMALLEST_SPREAD = 1e-3
"""Floor of spreads [rad, m]: a slot that never moves (a gripper that stays open) is not blown up to
noise."""
BOUNDS = {"min_max": ("min", "max"), "quantiles": ("q01", "q99"), "quantile10": ("q10", "q90")}
"""Statistics that [-1, 1] is mapped to."""
_OPENPI, _LEROBOT = 1e-6, 1e-8


class _Line(NamedTuple):
    shift: jax.Array
    divisor: jax.Array
    factor: jax.Array
    offset: float


def normalize(
    values: jax.Array, known: Mapping[str, jax.Array], mode: Mode, convention: Convention
) -> jax.Array:
    """`[..., J]` [rad, m] -> `[..., J]` f32.

    Args:
        values: states or actions.
        known: their statistics by name, `[J]` each.
        mode: see this file's head.
        convention: whose way with small spreads.

    Raises:
        ValueError: a statistic that the mode needs is not known.
    """
    values = values.astype(jnp.float32)
    if mode == "identity":
        return values
    line = _line(known, mode, convention)
    return (values - line.shift) / line.divisor + line.offset


def unnormalize(
    values: jax.Array, known: Mapping[str, jax.Array], mode: Mode, convention: Convention
) -> jax.Array:
    """The inverse of `normalize`, `[..., J]` f32 [rad, m]."""
    values = values.astype(jnp.float32)
    if mode == "identity":
        return values
    line = _line(known, mode, convention)
    return (values - line.offset) * line.factor + line.shift


def _line(known: Mapping[str, jax.Array], mode: Mode, convention: Convention) -> _Line:
    needed = BOUNDS.get(mode, ("mean", "std"))
    missing = [name for name in needed if name not in known]
    if missing:
        raise ValueError(
            f"normalisation {mode!r} needs {', '.join(needed)}; the statistics have "
            f"{', '.join(known) or 'nothing'}."
        )
    first, second = (known[name] for name in needed)
    spread = second if mode == "mean_std" else second - first
    if convention == "openpi":
        divisor = factor = spread + _OPENPI
    elif convention == "ours":
        divisor = factor = jnp.maximum(spread, SMALLEST_SPREAD)
    elif mode == "mean_std":
        divisor, factor = spread + _LEROBOT, spread
    else:
        divisor = factor = jnp.where(spread == 0, _LEROBOT, spread)
    half, offset = (1, 0.0) if mode == "mean_std" else (2, -1.0)
    return _Line(first, divisor / half, factor / half, offset)
