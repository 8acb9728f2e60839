"""Energy gate of LoRA-SP: keep the fewest directions whose squared scores reach an energy target.

For scores s >= 0, let E_k be the fraction of the energy Σ s² in the k largest scores (paper eq.
12). The gate keeps the smallest k with E_k >= η; ties go to the lowest index. Implementations:

- "pairwise": for each direction, sum the energy of all that rank before it. O(R²), in one pass;
  fastest on a CPU up to the paper's R = 128.
- "sort": sort the scores, accumulate energy, threshold. The reference; in rare cases, rounding of
  its cumulative sum changes whether η is reached.
- "bisection": binary search for the threshold, one bit per step, without a sort.
- "pallas": bisection that stops early, as a Triton kernel, one row per warp, scores in registers.

"sort" and "pallas" find each row's `Boundary`, the last kept (score, index). Comparing the scores
with it gives the mask. `kept_flags` is "pallas" for a block of rows inside another kernel.

η is the decimal as written, so 0.9 means 9/10. E_k >= 9/10 is tested as 10 Σ_k >= 9 Σ, where Σ_k is
the kept and Σ the total energy. Rows that reach η exactly thus do not depend on its rounding.

All implementations agree at the limits of fp32:

- The largest score has at least 1/R of the energy, so every η up to 1/R keeps one direction.
- Infinite scores share the energy equally; finite scores in the same row have zero energy.
- A row with NaN keeps nothing and its kept_energy is NaN.
"""

import decimal
import fractions
import functools
from collections.abc import Sequence
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl

from lorasp_jax.kernels.platform import platform
from lorasp_jax.kernels.row_sharding import by_rows
from lorasp_jax.kernels.threshold_search import (
    Boundary,
    Ratio,
    bisected_mask,
    block_boundary,
    energies,
    float_bits,
)

Implementation = Literal["pairwise", "sort", "bisection", "pallas"]

MIN_TARGET = 2.0**-64
"""A smaller η could underflow in fp32 and is raised to this value. Both keep one direction, because
no bank has 2^64."""

PAIRWISE_RANK = 128
"""Largest R at which "pairwise" is the default on CPU; above it, "bisection" is faster."""


def exact_ratio(energy_target: float) -> Ratio:
    """Convert η to an exact ratio, interpreting it as a decimal.

    Raises:
        ValueError: η is not a number in (0, 1].
    """
    try:
        ratio = fractions.Fraction(decimal.Decimal(str(energy_target)))
    except (decimal.InvalidOperation, ValueError, OverflowError):
        ratio = fractions.Fraction(0)
    if not 0 < ratio <= 1:
        raise ValueError(f"energy_target must lie in (0, 1], got {energy_target!r}")
    ratio = max(ratio, fractions.Fraction(MIN_TARGET))
    power = 2 ** ratio.denominator.bit_length()  # scaling by it is exact
    return Ratio(ratio.numerator / power, ratio.denominator / power)


def energy_gate(
    scores: jax.Array,
    energy_target: float,
    *,
    implementation: Implementation | None = None,
    interpret: bool = False,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Keep the fewest directions whose fraction of the energy reaches the target (eq. 12).

    No gradient flows through the mask; `kept_energy` is differentiable in the scores. A row of
    zeros keeps nothing and has `kept_energy` 1. η = 1 keeps every positive score.

    Args:
        scores: [..., R], non-negative, cast to fp32. For negative scores the magnitude is used.
        energy_target: η in (0, 1], a Python number, interpreted as an exact decimal.
        implementation: see the module docstring; None for `default_implementation(R)`.
        interpret: run "pallas" without a GPU, slowly.

    Returns:
        mask bool [..., R], active_rank f32 [...] = k, kept_energy f32 [...] = E_k.

    Raises:
        ValueError: η outside (0, 1] or an unknown implementation.
    """
    ratio = exact_ratio(energy_target)
    name = implementation or default_implementation(scores.shape[-1])
    if name not in get_args(Implementation):
        valid = ", ".join(get_args(Implementation))
        raise ValueError(f"implementation must be one of {valid}, got {name!r}")
    scores = scores.astype(jnp.float32)
    constant = jnp.abs(jax.lax.stop_gradient(scores))  # also clears the sign bit of -0
    if ratio.numerator == ratio.denominator:
        mask = positive(constant)
    elif name == "bisection":
        mask = bisected_mask(constant, ratio)
    else:
        # Without the barrier, XLA may compute the scores twice, for the boundary and for the
        # comparison with it, and round them differently. A kernel computes them once.
        constant = jax.lax.optimization_barrier(constant)
        if name == "pairwise":
            mask = _pairwise_mask(constant, ratio)
        else:
            pallas = functools.partial(_pallas_boundary, interpret=interpret)
            boundary = _sorted_boundary if name == "sort" else pallas
            mask = kept_mask(constant, boundary(constant, ratio))
    return mask, mask.sum(-1).astype(jnp.float32), kept_energy(scores, mask)


def default_implementation(rank: int) -> Implementation:
    """Choose "pallas" on GPU, "pairwise" on CPU up to `PAIRWISE_RANK`, else "bisection"."""
    backend = platform()
    if backend == "cpu" and rank <= PAIRWISE_RANK:
        return "pairwise"
    return "pallas" if backend == "gpu" else "bisection"


def kept_flags(scores: jax.Array, energy_target: float) -> jax.Array:
    """Compute the mask as int32 0 and 1, [..., R], inside a kernel, from f32 scores >= 0.

    A thread has seven registers for booleans; a kernel that holds more of them moves them to and
    from other registers one by one. These flags are integers from the start.
    """
    ratio, constant = exact_ratio(energy_target), jax.lax.stop_gradient(scores)
    keep_all = ratio.numerator == ratio.denominator
    return _positive_flags(constant) if keep_all else _boundary_flags(constant, ratio)


def _boundary_flags(scores: jax.Array, ratio: Ratio) -> jax.Array:
    """Compare with the boundary of `block_boundary`: the sign bit of a difference is the flag."""
    last = block_boundary(scores, ratio)
    position = jax.lax.broadcasted_iota(jnp.int32, scores.shape, scores.ndim - 1)
    is_later = jax.lax.shift_right_logical(last.index - position, 31)
    difference = float_bits(last.score) - 1 + is_later - float_bits(scores)
    keeps_any = (last.score == last.score).astype(jnp.int32)  # else NaN
    return jax.lax.shift_right_logical(difference, 31) & keeps_any


def _positive_flags(scores: jax.Array) -> jax.Array:
    """`positive` as int32."""
    keeps_any = (scores.sum(-1, keepdims=True) > 0).astype(jnp.int32)
    return jax.lax.shift_right_logical(-float_bits(scores), 31) & keeps_any


def positive(scores: jax.Array) -> jax.Array:
    """Return the mask at η = 1, bool [..., R]: positive scores, except in rows with NaN."""
    return (scores > 0) & (scores.sum(-1, keepdims=True) > 0)


def _pairwise_mask(scores: jax.Array, ratio: Ratio) -> jax.Array:
    """Keep each positive score if those that rank before it fall short of the energy target."""
    energy, position = energies(scores), np.arange(scores.shape[-1])
    other, own = scores[..., None, :], scores[..., :, None]
    ranks_before = (other > own) | ((other == own) & (position < position[:, None]))
    before = jnp.where(ranks_before, energy[..., None, :], 0).sum(-1)
    target = ratio.numerator * energy.sum(-1, keepdims=True)
    return (ratio.denominator * before < target) & (scores > 0)


def kept_mask(scores: jax.Array, last: Boundary) -> jax.Array:
    """Return the mask of the scores that rank at or before the boundary, bool [..., R]."""
    position = jax.lax.broadcasted_iota(jnp.int32, scores.shape, scores.ndim - 1)
    return (scores > last.score) | ((scores == last.score) & (position <= last.index))


def kept_energy(scores: jax.Array, mask: jax.Array) -> jax.Array:
    """Compute E_k of eq. (12), f32 [...], from f32 scores and a mask [..., R], bool or 0 and 1.

    A row of zeros gives 1 with zero gradient; a row with NaN gives NaN.
    """
    energy = energies(scores)
    total = energy.sum(-1)
    kept = (mask * energy).sum(-1)
    return jnp.where(total == 0, 1, kept / jnp.where(total == 0, 1, total))


def energy_share(scores: jax.Array) -> jax.Array:
    """Compute each direction's fraction of its row's energy, f32 [..., R]; rows of zeros give 0."""
    energy = energies(scores)
    total = energy.sum(-1, keepdims=True)
    return energy * (1 / jnp.where(total == 0, 1, total))


def _sorted_boundary(scores: jax.Array, ratio: Ratio) -> Boundary:
    """Find the boundaries by sorting, without argsort or a scatter."""
    rows = scores.reshape(-1, scores.shape[-1])
    last = jax.vmap(lambda row: _sorted_row_boundary(row, ratio))(rows)
    return jax.tree.map(lambda leaf: leaf.reshape(*scores.shape[:-1], 1), last)


def _sorted_row_boundary(scores: jax.Array, ratio: Ratio) -> Boundary:
    descending = jnp.flip(jnp.sort(scores))
    energy = energies(descending)
    before = jnp.cumsum(jnp.roll(energy.at[-1].set(0), 1))
    kept = (ratio.denominator * before < ratio.numerator * energy.sum()) & (descending > 0)
    score = jnp.where(kept.any(), jnp.where(kept, descending, jnp.inf).min(), jnp.nan)
    tied = scores == score
    num_ties = kept.sum() - (scores > score).sum()
    index = (jnp.cumsum(tied) < num_ties).sum()  # position of the last kept tie
    return Boundary(score, index.astype(jnp.int32))


def _pallas_boundary(scores: jax.Array, ratio: Ratio, *, interpret: bool) -> Boundary:
    """Run `block_boundary` as a Triton kernel; R is padded with zeros, which are never kept."""
    *leading, rank = scores.shape
    width = max(pl.next_power_of_2(rank), 2)
    rows = jnp.pad(scores.reshape(-1, rank), ((0, 0), (0, width - rank)))
    (score, index), _ = by_rows(functools.partial(_call_kernel, ratio, interpret), [], [rows])
    return Boundary(score.reshape(*leading, 1), index.reshape(*leading, 1))


def _call_kernel(ratio: Ratio, interpret: bool, _: Any, arrays: Sequence[jax.Array]) -> tuple:
    """Compute the columns of `Boundary`; there are no sums for `by_rows`."""
    from jax.experimental.pallas import triton  # absent from builds without NVIDIA support

    (rows,), column = arrays, pl.BlockSpec((1, 1), lambda i: (i, 0))
    columns = pl.pallas_call(
        functools.partial(_boundary_kernel, ratio=ratio),
        grid=(len(rows),),  # one row and one warp per program: the fastest measured on an H200
        in_specs=[pl.BlockSpec((1, rows.shape[1]), lambda i: (i, 0))],
        out_specs=[column, column],
        out_shape=[jax.ShapeDtypeStruct((len(rows), 1), t) for t in (jnp.float32, jnp.int32)],
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
        name="energy_gate",
    )(rows)
    return columns, []


def _boundary_kernel(scores: Any, score: Any, index: Any, *, ratio: Ratio) -> None:
    """Read a block of scores [rows, width] and write the two columns of its `Boundary`."""
    for ref, column in zip((score, index), block_boundary(scores[...], ratio), strict=True):
        ref[...] = jnp.broadcast_to(column, ref.shape)
