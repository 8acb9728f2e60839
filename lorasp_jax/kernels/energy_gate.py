"""The energy gate of LoRA-SP: the fewest directions whose squared scores reach an energy target.

For scores s >= 0 let E_k be the energy share of the k largest squares (paper eq. 12). The gate
keeps the smallest k with E_k >= η, ties by lowest index. All implementations but the first reduce a
row to its `Boundary`, the last kept (score, index) in that order; the mask follows elementwise.

- "pairwise": for each direction the energy of those that rank before it, summed term by term.
  R^2 work in one vectorised kernel, the fastest on CPU up to R = 32.
- "sort": value sort, cumulative energy, threshold. The reference; its running sum may round across
  η on a rare row.
- "bisection": no sort. Binary search on the bits of the threshold, since fp32 numbers >= 0 are
  ordered as their bit patterns.
- "block": the same for a few rows, which stop as soon as they know: the body of a kernel.
- "pallas": "block" in a Triton kernel of its own, a row to a warp, scores held in registers.

η is the decimal that was written: 0.9 means 9/10, and E_k >= 9/10 is tested as 10 Σ_k >= 9 Σ, so a
row that reaches the target exactly is not lost to the rounding of 0.9.
"""

import decimal
import fractions
import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl

from lorasp_jax.kernels.by_rows import by_rows

Implementation = Literal["pairwise", "sort", "bisection", "block", "pallas"]

PAIRWISE_RANK = 32
"""Largest R for which pairwise is the default on CPU: the crossing of both on two cores."""


class Boundary(NamedTuple):
    """The last kept position of each row: keep s > score, and s == score up to `index`."""

    score: jax.Array  # f32 [..., 1], of one row alone []; NaN where nothing is kept
    index: jax.Array  # int32, the same


class Ratio(NamedTuple):
    """η as numerator / denominator, in [0, 1], exact in fp32 for decimals of up to 7 digits."""

    numerator: float | jax.Array  # an array where η is one
    denominator: float


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
    power = 2 ** ratio.denominator.bit_length()  # scales both without rounding
    return Ratio(ratio.numerator / power, ratio.denominator / power)


def energy_gate(
    scores: jax.Array, energy_target: float, *, implementation: Implementation | None = None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Keeps the smallest set of directions whose energy share reaches the target (eq. 12).

    No gradient flows through the mask; `kept_energy` is differentiable in the scores. A row of
    zeros keeps nothing and has `kept_energy` 1. At η = 1 every positive score is kept.

    Args:
      scores: [..., R], non-negative and finite; computed in fp32.
      energy_target: η in (0, 1], a Python number, read as an exact decimal.
      implementation: how to find the mask; None takes `default_implementation(R)`.

    Returns:
      mask bool [..., R], active_rank f32 [...] = k, kept_energy f32 [...] = E_k.

    Raises:
      ValueError: η outside (0, 1] or an unknown implementation.
    """
    ratio = exact_ratio(energy_target)
    find = _finder(implementation or default_implementation(scores.shape[-1]))
    scores = scores.astype(jnp.float32)
    constant = jax.lax.stop_gradient(scores)
    mask = constant > 0 if ratio.numerator == ratio.denominator else find(constant, ratio)
    return mask, mask.sum(-1).astype(jnp.float32), kept_energy(scores, mask)


def default_implementation(rank: int) -> Implementation:
    """Pallas on NVIDIA GPUs, pairwise for a small bank on CPU, bisection in XLA elsewhere."""
    backend = jax.default_backend()
    if backend == "cpu" and rank <= PAIRWISE_RANK:
        return "pairwise"
    return "pallas" if backend == "gpu" else "bisection"


def _finder(implementation: str) -> Callable[[jax.Array, Ratio], jax.Array]:
    """The function from scores [..., R] and η to the mask."""
    boundaries = {
        "sort": _sorted_boundary,
        "bisection": bisected_boundary,
        "block": _block_boundary,
        "pallas": _pallas_boundary,
    }
    if implementation == "pairwise":
        return _pairwise_mask
    if implementation not in boundaries:
        valid = ", ".join(("pairwise", *boundaries))
        raise ValueError(f"unknown gate {implementation!r}; valid are {valid}.")
    boundary = boundaries[implementation]
    return lambda scores, ratio: kept_mask(scores, boundary(scores, ratio))


def _pairwise_mask(scores: jax.Array, ratio: Ratio) -> jax.Array:
    """Keeps what falls short of the target with all that ranks before it; zeros are never kept."""
    energy = _energy(scores)
    position = jax.lax.broadcasted_iota(jnp.int32, scores.shape, scores.ndim - 1)
    before = jnp.zeros_like(scores)
    for j in range(scores.shape[-1]):  # unrolled: one kernel, vectorised over rows and R
        other = scores[..., j : j + 1]
        first = (other > scores) | ((other == scores) & (j < position))
        before += jnp.where(first, energy[..., j : j + 1], 0)
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
    energy = _energy(scores)
    total = energy.sum(-1)
    kept = jnp.where(mask, energy, 0).sum(-1)
    return jnp.where(total == 0, 1, kept / jnp.where(total == 0, 1, total))


def energy_share(scores: jax.Array) -> jax.Array:
    """Share of each direction in its row's energy, for f32 scores [..., R]; 0 in a row of zeros."""
    energy = _energy(scores)
    total = energy.sum(-1, keepdims=True)
    return energy * (1 / jnp.where(total == 0, 1, total))


def _energy(scores: jax.Array) -> jax.Array:
    """s² of rows scaled by the power of two that brings their maximum into [1/2, 1).

    The scaling is exact, E_k does not depend on it, and squares neither under- nor overflow. For a
    maximum with exponent field e it is 2^(126 - e), with field 253 - e (at least 1: normal).
    """
    largest = jax.lax.stop_gradient(scores).max(-1, keepdims=scores.ndim > 1)
    exponent = jax.lax.shift_right_logical(_bits(largest), 23)
    scale = _float(jax.lax.shift_left(jnp.maximum(253 - exponent, 1), 23))
    return jnp.square(scores * scale)


def _bits(x: jax.Array) -> jax.Array:
    return jax.lax.bitcast_convert_type(x, jnp.int32)


def _float(bits: jax.Array) -> jax.Array:
    return jax.lax.bitcast_convert_type(bits, jnp.float32)


class _Bracket(NamedTuple):
    """Bits of scores, int32 [..., 1]: those from `low` on reach the target, from `high` on not."""

    low: jax.Array
    high: jax.Array
    num_low: jax.Array
    """How many scores there are from `low` on."""
    num_high: jax.Array


def bisected_boundary(scores: jax.Array, ratio: Ratio, *, is_block: bool = False) -> Boundary:
    """A binary search for the largest score that reaches the target together with all above it, and
    one for the last tie of it that is needed.

    Only elementwise work and row sums: the XLA implementation is also the Pallas kernel's body. A
    few rows, a block, stop as soon as they know (11 steps of 31 for softplus scores, R = 128). For
    many rows in XLA there is nothing to gain, and devices that share them would ask one another.
    One row, [R], has scalars, whose comparison costs a kernel nothing.
    """
    energy = _energy(scores)
    keepdims = scores.ndim > 1
    total, largest = (functools.partial(f, axis=-1, keepdims=keepdims) for f in (jnp.sum, jnp.max))
    target = ratio.numerator * total(energy)

    def halve(bracket: _Bracket) -> _Bracket:
        middle = bracket.low + jax.lax.shift_right_logical(bracket.high - bracket.low, 1)
        chosen = scores >= _float(middle)
        number = total(chosen.astype(jnp.int32), dtype=jnp.int32)
        reached = total(jnp.where(chosen, energy, 0))
        is_low = ratio.denominator * reached >= target
        upper = bracket._replace(low=middle, num_low=number)
        lower = bracket._replace(high=middle, num_high=number)
        return jax.tree.map(functools.partial(jnp.where, is_low), upper, lower)

    lowest, highest = (_bits(f(scores, axis=-1, keepdims=keepdims)) for f in (jnp.min, jnp.max))
    none = jnp.zeros_like(lowest)
    bracket = _Bracket(lowest, highest + 1, none + scores.shape[-1], none)
    if is_block:
        bracket = jax.lax.while_loop(
            lambda b: _any((b.high - b.low > 1) & (b.num_low - b.num_high > 1)), halve, bracket
        )
    else:
        bracket = jax.lax.fori_loop(0, 31, lambda _, b: halve(b), bracket)
    # What is left in the bracket is one score, or ties.
    score = largest(jnp.where(scores < _float(bracket.high), scores, -1))
    index = functools.partial(_last_tie, scores, energy, score, target, ratio)
    if is_block:
        several = _any(bracket.num_low - bracket.num_high > 1)
        index = functools.partial(jax.lax.cond, several, index, lambda: none + scores.shape[-1])
    return Boundary(jnp.where(target > 0, score, jnp.nan), index())


def _block_boundary(scores: jax.Array, ratio: Ratio) -> Boundary:
    """`bisected_boundary` of a block of rows, [n, R] or, of one, [R]."""
    rows = scores.reshape(-1) if len(scores) == 1 else scores
    return bisected_boundary(rows, ratio, is_block=True)


def _last_tie(
    scores: jax.Array, energy: jax.Array, score: jax.Array, target: jax.Array, ratio: Ratio
) -> jax.Array:
    """Index of the last position of `score` that is needed, int32 [..., 1].

    Ties share one energy; one is kept while the energy before it falls short of the target.
    """
    keepdims = scores.ndim > 1
    above = jnp.where(scores > score, energy, 0).sum(-1, keepdims=keepdims)
    tied = scores == score
    each = jnp.where(tied, energy, 0).max(-1, keepdims=keepdims)
    position = jax.lax.broadcasted_iota(jnp.int32, scores.shape, scores.ndim - 1)
    num_bits = (scores.shape[-1] - 1).bit_length()

    def step(i: jax.Array, found: jax.Array) -> jax.Array:
        candidate = found | jax.lax.shift_left(jnp.int32(1), num_bits - 1 - i)
        before = (tied & (position < candidate)).astype(jnp.float32).sum(-1, keepdims=keepdims)
        falls_short = ratio.denominator * (above + before * each) < target
        return jnp.where(falls_short, candidate, found)

    return jax.lax.fori_loop(0, num_bits, step, jnp.zeros_like(score, jnp.int32))


def _any(condition: jax.Array) -> jax.Array:
    """Whether it holds in any row; Triton reduces numbers."""
    return condition.astype(jnp.int32).max() > 0


def _sorted_boundary(scores: jax.Array, ratio: Ratio) -> Boundary:
    """Reference: value sort, cumulative energy, threshold; no argsort, nothing scattered back."""
    rows = scores.reshape(-1, scores.shape[-1])
    last = jax.vmap(lambda row: _sorted_row_boundary(row, ratio))(rows)
    return jax.tree.map(lambda leaf: leaf.reshape(*scores.shape[:-1], 1), last)


def _sorted_row_boundary(scores: jax.Array, ratio: Ratio) -> Boundary:
    descending = jnp.flip(jnp.sort(scores))
    energy = _energy(descending)
    before = jnp.cumsum(jnp.roll(energy.at[-1].set(0), 1))
    kept = (ratio.denominator * before < ratio.numerator * energy.sum()) & (descending > 0)
    score = jnp.where(kept.any(), jnp.where(kept, descending, jnp.inf).min(), jnp.nan)
    tied = scores == score
    num_ties = kept.sum() - (scores > score).sum()
    index = (jnp.cumsum(tied) < num_ties).sum()  # tied scores up to here: num_ties of them
    return Boundary(score, index.astype(jnp.int32))


def _pallas_boundary(scores: jax.Array, ratio: Ratio, *, interpret: bool = False) -> Boundary:
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
    for ref, found in zip((score, index), _block_boundary(scores[...], ratio), strict=True):
        ref[...] = jnp.broadcast_to(found, ref.shape)
