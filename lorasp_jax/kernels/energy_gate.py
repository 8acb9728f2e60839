"""The energy gate of LoRA-SP: the fewest directions whose squared scores reach an energy target.

For scores s >= 0 let E_k be the energy share of the k largest squares (paper eq. 12). The gate
keeps the smallest k with E_k >= η, ties by lowest index. All implementations but the first reduce a
row to its `Boundary`, the last kept (score, index) in that order; the mask follows elementwise.

- "pairwise": for each direction the energy of those that rank before it, summed term by term.
  R^2 work, vectorised over rows and R, the fastest on CPU up to R = 32.
- "sort": value sort, cumulative energy, threshold. The reference; its running sum may round across
  η on a rare row.
- "bisection": no sort. Binary search on the bits of the threshold, since fp32 numbers >= 0 are
  ordered as their bit patterns.
- "block": the same for a few rows, which stop as soon as they know: the body of a kernel.
- "pallas": "block" in a Triton kernel of its own, a row to a warp, scores held in registers.

η is the decimal that was written: 0.9 means 9/10, and E_k >= 9/10 is tested as 10 Σ_k >= 9 Σ, so a
row that reaches the target exactly is not lost to the rounding of 0.9.

What all implementations give where fp32 ends:

- The first direction alone holds at least 1/R of the energy, so every η up to 1/R keeps one.
- Infinite scores share the energy equally, and finite ones beside them have none.
- A row with NaN keeps nothing and has kept_energy NaN.
"""

import decimal
import fractions
import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl

from lorasp_jax.kernels.bisection import (
    Boundary,
    Ratio,
    bisected_mask,
    block_boundary,
    energies,
)
from lorasp_jax.kernels.row_sharding import by_rows

Implementation = Literal["pairwise", "sort", "bisection", "block", "pallas"]

SMALLEST_TARGET = 2.0**-64
"""Every smaller η is as this one, since no bank has 2^64 directions; in fp32 it could be zero."""

PAIRWISE_RANK = 32
"""Largest R for which pairwise is the default on CPU: the crossing of both on two cores."""


def exact_ratio(energy_target: float) -> Ratio:
    """Reads η as the decimal it was written as.

    Raises:
      ValueError: η is not a number in (0, 1].
    """
    try:
        ratio = fractions.Fraction(decimal.Decimal(str(energy_target)))
    except (decimal.InvalidOperation, ValueError, OverflowError):
        ratio = fractions.Fraction(0)
    if not 0 < ratio <= 1:
        raise ValueError(f"energy_target must lie in (0, 1], got {energy_target!r}.")
    ratio = max(ratio, fractions.Fraction(SMALLEST_TARGET))
    power = 2 ** ratio.denominator.bit_length()  # scales both without rounding
    return Ratio(ratio.numerator / power, ratio.denominator / power)


def energy_gate(
    scores: jax.Array,
    energy_target: float,
    *,
    implementation: Implementation | None = None,
    interpret: bool = False,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Keeps the smallest set of directions whose energy share reaches the target (eq. 12).

    No gradient flows through the mask; `kept_energy` is differentiable in the scores. A row of
    zeros keeps nothing and has `kept_energy` 1. At η = 1 every positive score is kept.

    Args:
      scores: [..., R], non-negative; computed in fp32. Of a negative one the magnitude counts.
      energy_target: η in (0, 1], a Python number, read as an exact decimal.
      implementation: how to find the mask; None takes `default_implementation(R)`.
      interpret: for "pallas" without a GPU: its kernel's body, as XLA operations.

    Returns:
      mask bool [..., R], active_rank f32 [...] = k, kept_energy f32 [...] = E_k.

    Raises:
      ValueError: η outside (0, 1] or an unknown implementation.
    """
    ratio = exact_ratio(energy_target)
    find = _finder(implementation or default_implementation(scores.shape[-1]), interpret)
    scores = scores.astype(jnp.float32)
    constant = jnp.abs(jax.lax.stop_gradient(scores))  # no -0, which the bits would put below all
    whole = ratio.numerator == ratio.denominator
    mask = positive(constant) if whole else find(constant, ratio)
    return mask, mask.sum(-1).astype(jnp.float32), kept_energy(scores, mask)


def default_implementation(rank: int) -> Implementation:
    """Pallas on NVIDIA GPUs, pairwise for a small bank on CPU, bisection in XLA elsewhere."""
    backend = jax.default_backend()
    if backend == "cpu" and rank <= PAIRWISE_RANK:
        return "pairwise"
    return "pallas" if backend == "gpu" else "bisection"


def _finder(implementation: str, interpret: bool) -> Callable[[jax.Array, Ratio], jax.Array]:
    """The function from scores [..., R] and η to the mask."""
    masks = {"pairwise": _pairwise_mask, "bisection": bisected_mask}
    boundaries = {
        "sort": _sorted_boundary,
        "block": block_boundary,
        "pallas": functools.partial(_pallas_boundary, interpret=interpret),
    }
    if implementation in masks:
        return masks[implementation]
    if implementation not in boundaries:
        valid = ", ".join(get_args(Implementation))
        raise ValueError(f"unknown gate {implementation!r}; valid are {valid}.")
    boundary = boundaries[implementation]
    # A kernel computes scores once. XLA may do so twice, and round them differently, the boundary
    # and what is compared with it.
    once = (lambda scores: scores) if implementation == "block" else jax.lax.optimization_barrier

    def find(scores: jax.Array, ratio: Ratio) -> jax.Array:
        scores = once(scores)
        return kept_mask(scores, boundary(scores, ratio))

    return find


def positive(scores: jax.Array) -> jax.Array:
    """The mask at η = 1, bool [..., R]: every score that is not zero, none in a row with NaN."""
    return (scores > 0) & (scores.sum(-1, keepdims=True) > 0)


def _pairwise_mask(scores: jax.Array, ratio: Ratio) -> jax.Array:
    """Keeps what falls short of the target with all that ranks before it; zeros are never kept."""
    energy = energies(scores)
    position = np.arange(scores.shape[-1])

    def add(j: jax.Array, before: jax.Array) -> jax.Array:
        other, its_energy = (jax.lax.dynamic_index_in_dim(a, j, -1) for a in (scores, energy))
        first = (other > scores) | ((other == scores) & (j < position))
        return before + jnp.where(first, its_energy, 0)

    before = jax.lax.fori_loop(0, scores.shape[-1], add, jnp.zeros_like(scores))
    target = ratio.numerator * energy.sum(-1, keepdims=True)
    return (ratio.denominator * before < target) & (scores > 0)


def kept_mask(scores: jax.Array, last: Boundary) -> jax.Array:
    """The mask, bool [..., R], of scores up to the last that is kept."""
    position = jax.lax.broadcasted_iota(jnp.int32, scores.shape, scores.ndim - 1)
    return (scores > last.score) | ((scores == last.score) & (position <= last.index))


def kept_energy(scores: jax.Array, mask: jax.Array) -> jax.Array:
    """E_k of eq. (12) for f32 scores and a mask [..., R], f32 [...].

    1 for a row of zeros, with a zero gradient there, and NaN for NaN.
    """
    energy = energies(scores)
    total = energy.sum(-1)
    kept = jnp.where(mask, energy, 0).sum(-1)
    return jnp.where(total == 0, 1, kept / jnp.where(total == 0, 1, total))


def energy_share(scores: jax.Array) -> jax.Array:
    """Share of each direction in its row's energy, for f32 scores [..., R]; 0 in a row of zeros."""
    energy = energies(scores)
    total = energy.sum(-1, keepdims=True)
    return energy * (1 / jnp.where(total == 0, 1, total))


def _sorted_boundary(scores: jax.Array, ratio: Ratio) -> Boundary:
    """Reference: value sort, cumulative energy, threshold; no argsort, nothing scattered back."""
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
    index = (jnp.cumsum(tied) < num_ties).sum()  # tied scores up to here: num_ties of them
    return Boundary(score, index.astype(jnp.int32))


def _pallas_boundary(scores: jax.Array, ratio: Ratio, *, interpret: bool) -> Boundary:
    """The bisection as a Triton kernel; R is padded with zeros, which are never kept."""
    *leading, rank = scores.shape
    width = max(pl.next_power_of_2(rank), 2)
    rows = jnp.pad(scores.reshape(-1, rank), ((0, 0), (0, width - rank)))
    (score, index), _ = by_rows(functools.partial(_call_kernel, ratio, interpret), [], [rows])
    return Boundary(score.reshape(*leading, 1), index.reshape(*leading, 1))


def _call_kernel(ratio: Ratio, interpret: bool, _: Any, arrays: Sequence[jax.Array]) -> tuple:
    """The two columns of `Boundary`, and no sums, for rows of scores."""
    from jax.experimental.pallas import triton  # absent from builds without NVIDIA support

    (rows,), column = arrays, pl.BlockSpec((1, 1), lambda i: (i, 0))
    columns = pl.pallas_call(
        functools.partial(_boundary_kernel, ratio=ratio),
        grid=(len(rows),),  # one row and one warp to a program: the fastest measured
        in_specs=[pl.BlockSpec((1, rows.shape[1]), lambda i: (i, 0))],
        out_specs=[column, column],
        out_shape=[jax.ShapeDtypeStruct((len(rows), 1), t) for t in (jnp.float32, jnp.int32)],
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
        name="energy_gate",
    )(rows)
    return columns, []


def _boundary_kernel(scores: Any, score: Any, index: Any, *, ratio: Ratio) -> None:
    """One program: references to scores [rows, width] in, to the two columns of `Boundary` out."""
    for ref, found in zip((score, index), block_boundary(scores[...], ratio), strict=True):
        ref[...] = jnp.broadcast_to(found, ref.shape)
