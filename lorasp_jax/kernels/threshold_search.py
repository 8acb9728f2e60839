"""Find the energy gate's threshold by bisection, without a sort.

Non-negative fp32 numbers sort like their bit patterns read as integers. A binary search over these
integers needs only comparisons and row sums. `bisected_mask` searches all rows at once in XLA,
`block_boundary` a few rows in a kernel.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

UNCOUNTED_STEPS = 8
"""Steps of the search in a kernel before it looks whether rows are decided."""


class Boundary(NamedTuple):
    """Last kept score of each row; larger ones are kept, and ties up to and including `index`."""

    score: jax.Array  # f32 [..., 1], [] for a single row; NaN where nothing is kept
    index: jax.Array  # int32, same shape


class Ratio(NamedTuple):
    """η in [0, 1] as numerator / denominator, exact in fp32 for decimals of up to 7 digits."""

    numerator: float
    denominator: float


def energies(scores: jax.Array) -> jax.Array:
    """Square the scores after scaling each row by a power of two to a maximum of order 1.

    The scaling is exact and cancels in E_k. No square overflows, and the largest does not
    underflow. If the maximum has the exponent field e, the factor 2^(126 - e) scales it to
    [1/2, 1). The factor's own field is 253 - e, but at least 1, so that it stays normal.

    Infinite scores get energy 1, and finite scores in the same row 0. NaN stays NaN, even if the
    maximum ignores it, as in Triton.
    """
    largest = _by_row(jnp.max, jnp.abs(jax.lax.stop_gradient(scores)))
    exponent = jax.lax.shift_right_logical(float_bits(largest), 23)
    scale = _float(jax.lax.shift_left(jnp.maximum(253 - exponent, 1), 23))
    scale = jnp.where(largest == jnp.inf, 0, scale)
    return jnp.square(jnp.where(jnp.abs(scores) == jnp.inf, 1, scores * scale))


def _by_row(reduce: Callable, rows: jax.Array, **options: Any) -> jax.Array:
    """Reduce the last axis of [..., R] to [..., 1]; a single row gives a scalar."""
    return reduce(rows, axis=-1, keepdims=rows.ndim > 1, **options)


def float_bits(x: jax.Array) -> jax.Array:
    """Return the bits of f32 as int32; non-negative numbers sort like them."""
    return jax.lax.bitcast_convert_type(x, jnp.int32)


def _float(bits: jax.Array) -> jax.Array:
    return jax.lax.bitcast_convert_type(bits, jnp.float32)


class _Bracket(NamedTuple):
    """Search interval of scores, as bit patterns, int32 [..., 1].

    The scores >= `low` together reach the energy target; those >= `high` do not.
    """

    low: jax.Array
    high: jax.Array
    num_low: jax.Array
    """Number of scores >= `low`."""
    num_high: jax.Array
    """Number of scores >= `high`."""


def bisected_mask(scores: jax.Array, ratio: Ratio) -> jax.Array:
    """Compute the mask, bool [..., R], with a search over all rows at once in XLA.

    The search finds the largest threshold such that the scores at or above it reach the target. It
    sets one bit per step, from the highest down. Each step also decides some scores. If those at or
    above the candidate fall short of the target, all of them are kept. Otherwise, all scores below
    it are dropped. At the end, only ties with the threshold are undecided. A tie is kept if the
    energy before it falls short of the target.

    Comparing the scores with the threshold after the loop would be simpler, but XLA may recompute
    them there and round them differently.
    """
    energy = energies(scores)
    target = ratio.numerator * energy.sum(-1, keepdims=True)

    def step(i: jax.Array, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        threshold, decision = carry
        # Bit 31 is the sign, which is 0.
        candidate = threshold | jax.lax.shift_left(jnp.int32(1), 30 - i)
        above = scores >= _float(candidate)
        reached = ratio.denominator * jnp.where(above, energy, 0).sum(-1, keepdims=True) >= target
        # Reached: whatever lies below is dropped. Not reached: whatever lies above is kept.
        update = jnp.where(reached, jnp.int8(-1), jnp.int8(1))
        threshold = jnp.where(reached, candidate, threshold)
        # The other side stays as it was decided before.
        return threshold, jnp.where(above == reached, decision, update)

    start = jnp.zeros_like(target, jnp.int32), jnp.zeros_like(scores, jnp.int8)
    _, decision = jax.lax.fori_loop(0, 31, step, start)
    kept, tied = decision > 0, decision == 0
    # The product with a triangular matrix counts the ties before each one.
    earlier = np.triu(np.ones((scores.shape[-1],) * 2, np.float32), 1)
    ties_before = tied.astype(jnp.float32) @ earlier
    before = jnp.where(kept, energy, 0).sum(-1, keepdims=True) + ties_before * energy
    # A target of 0 belongs to a row of zeros; one of NaN compares as False, too.
    return (kept | (tied & (ratio.denominator * before < target))) & (target > 0)


def block_boundary(scores: jax.Array, ratio: Ratio) -> Boundary:
    """Find the boundaries of a block of rows [..., R] inside a kernel.

    One binary search finds the largest score s such that the scores >= s together reach the target.
    It stops once all rows of the block are decided: for softplus scores and R = 128, after 11 of 31
    steps. The first steps only halve: to tell whether a row is decided costs as much as halving. A
    second search finds the last tie with s that is needed. A single row gives scalars, whose
    comparisons cost nothing in a kernel.
    """
    if scores.size == scores.shape[-1]:  # a single row
        scores = scores.reshape(-1)
    energy = energies(scores)
    target = ratio.numerator * _by_row(jnp.sum, energy)

    def reaches(threshold: jax.Array) -> tuple[jax.Array, jax.Array]:
        above = scores >= _float(threshold)
        reached = _by_row(jnp.sum, jnp.where(above, energy, 0))
        return ratio.denominator * reached >= target, above

    def halve(_: Any, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        middle = _middle(*ends)
        is_low, _ = reaches(middle)
        return jnp.where(is_low, middle, ends[0]), jnp.where(is_low, ends[1], middle)

    def halve_and_count(bracket: _Bracket) -> _Bracket:
        middle = _middle(bracket.low, bracket.high)
        is_low, above = reaches(middle)
        count = _count(above)
        upper_half = bracket._replace(low=middle, num_low=count)
        lower_half = bracket._replace(high=middle, num_high=count)
        return jax.tree.map(functools.partial(jnp.where, is_low), upper_half, lower_half)

    # All scores reach the target, and none does, so the bracket is the row's own range.
    lowest, highest = (float_bits(_by_row(f, scores)) for f in (jnp.min, jnp.max))
    zero = jnp.zeros_like(lowest)
    ends = jax.lax.fori_loop(0, UNCOUNTED_STEPS, halve, (lowest, highest + 1))
    # Undecided: more than one score lies in the bracket, which can still be halved.
    bracket = jax.lax.while_loop(
        lambda b: _any((b.high - b.low > 1) & (b.num_low - b.num_high > 1)),
        halve_and_count,
        _Bracket(*ends, *(_count(scores >= _float(end)) for end in ends)),
    )
    # The bracket now holds a single score or ties: take the largest score below its upper end.
    score = _by_row(jnp.max, jnp.where(scores <= _float(bracket.high - 1), scores, -1))
    last_tie = functools.partial(_last_tie, scores, energy, score, target, ratio)
    # Ties are rare, so the second search runs only if a row of the block has some.
    has_ties = _any(bracket.num_low - bracket.num_high > 1)
    boundary_score = jnp.where(target > 0, score, jnp.nan)
    return Boundary(
        boundary_score, jax.lax.cond(has_ties, last_tie, lambda: zero + scores.shape[-1])
    )


def _last_tie(
    scores: jax.Array, energy: jax.Array, score: jax.Array, target: jax.Array, ratio: Ratio
) -> jax.Array:
    """Find the index of the last kept tie of `score`, int32 [..., 1].

    All ties have the same energy; a tie is kept if the energy before it falls short of the target.
    """
    above = _by_row(jnp.sum, jnp.where(scores > score, energy, 0))
    tied = scores == score
    tie_energy = _by_row(jnp.max, jnp.where(tied, energy, 0))
    position = jax.lax.broadcasted_iota(jnp.int32, scores.shape, scores.ndim - 1)
    num_bits = (scores.shape[-1] - 1).bit_length()  # of an index

    def step(i: jax.Array, index: jax.Array) -> jax.Array:
        candidate = index | jax.lax.shift_left(jnp.int32(1), num_bits - 1 - i)
        before = _by_row(jnp.sum, (tied & (position < candidate)).astype(jnp.float32))
        # The largest index whose ties before it fall short is that of the last kept tie.
        falls_short = ratio.denominator * (above + before * tie_energy) < target
        return jnp.where(falls_short, candidate, index)

    return jax.lax.fori_loop(0, num_bits, step, jnp.zeros_like(score, jnp.int32))


def _middle(low: jax.Array, high: jax.Array) -> jax.Array:
    return low + jax.lax.shift_right_logical(high - low, 1)


def _count(rows: jax.Array) -> jax.Array:
    """Count True in each row, int32."""
    return _by_row(jnp.sum, rows.astype(jnp.int32), dtype=jnp.int32)


def _any(condition: jax.Array) -> jax.Array:
    """Return whether the condition holds in any row; Triton cannot reduce booleans."""
    return condition.astype(jnp.int32).max() > 0
