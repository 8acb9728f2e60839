"""The search for the last score that an energy gate keeps, without a sort.

Numbers >= 0 in fp32 are ordered as their bit patterns, so a binary search on those bits finds the
threshold by comparisons and row sums alone: of all rows in XLA, of a few in a kernel's body.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Boundary(NamedTuple):
    """The last kept position of each row: keep s > score, and s == score up to `index`."""

    score: jax.Array  # f32 [..., 1], of one row alone []; NaN where nothing is kept
    index: jax.Array  # int32, the same


class Ratio(NamedTuple):
    """η as numerator / denominator, in [0, 1], exact in fp32 for decimals of up to 7 digits."""

    numerator: float | jax.Array  # an array where η is one
    denominator: float


def energies(scores: jax.Array) -> jax.Array:
    """s² of rows scaled by the power of two that brings their maximum into [1/2, 1).

    The scaling is exact, E_k does not depend on it, and squares neither under- nor overflow. For a
    maximum with exponent field e it is 2^(126 - e), with field 253 - e (at least 1: normal).

    Of a row with infinite scores it is the limit: these have energy 1, finite ones 0. NaN stays
    NaN, also where a backend's maximum passes over it (Triton's does).
    """
    largest = _by_row(jnp.max, jnp.abs(jax.lax.stop_gradient(scores)))
    exponent = jax.lax.shift_right_logical(_bits(largest), 23)
    scale = _float(jax.lax.shift_left(jnp.maximum(253 - exponent, 1), 23))
    scale = jnp.where(largest == jnp.inf, 0, scale)
    return jnp.square(jnp.where(jnp.abs(scores) == jnp.inf, 1, scores * scale))


def _by_row(reduce: Callable, rows: jax.Array, **options: Any) -> jax.Array:
    """A number of each row [..., R]: [..., 1], of one row alone []."""
    return reduce(rows, axis=-1, keepdims=rows.ndim > 1, **options)


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


def bisected_mask(scores: jax.Array, ratio: Ratio) -> jax.Array:
    """The mask, bool [..., R]: a search in all rows at once, for XLA.

    Bit by bit it finds the largest score that reaches the target together with all above it. Each
    step gives verdicts: what is above a threshold that falls short is kept, what is below one that
    reaches is not. In the end only ties of the last score are open, and of these each is kept while
    the energy before it falls short.

    Verdicts are given inside the loop, as a score found there must not be compared with others
    outside: XLA may compute them once more for that, and round them differently.
    """
    energy = energies(scores)
    target = ratio.numerator * energy.sum(-1, keepdims=True)

    def step(i: jax.Array, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        found, verdict = carry
        candidate = found | jax.lax.shift_left(jnp.int32(1), 30 - i)
        chosen = scores >= _float(candidate)
        reached = ratio.denominator * jnp.where(chosen, energy, 0).sum(-1, keepdims=True) >= target
        news = jnp.where(reached, jnp.int8(-1), jnp.int8(1))
        return jnp.where(reached, candidate, found), jnp.where(chosen == reached, verdict, news)

    start = jnp.zeros_like(target, jnp.int32), jnp.zeros_like(scores, jnp.int8)
    _, verdict = jax.lax.fori_loop(0, 31, step, start)
    kept, tied = verdict > 0, verdict == 0
    earlier = np.triu(np.ones((scores.shape[-1],) * 2, np.float32), 1)
    ties_before = tied.astype(jnp.float32) @ earlier
    before = jnp.where(kept, energy, 0).sum(-1, keepdims=True) + ties_before * energy
    return (kept | (tied & (ratio.denominator * before < target))) & (target > 0)


def block_boundary(scores: jax.Array, ratio: Ratio) -> Boundary:
    """The boundary of a block of rows [..., R]: the body of a kernel, which computes scores once.

    A binary search for the largest score that reaches the target together with all above it, and
    one for the last tie of it that is needed: only elementwise work and row sums. A few rows stop
    as soon as they know (11 steps of 31 for softplus scores, R = 128). One row has scalars, whose
    comparison costs a kernel nothing.
    """
    if scores.size == scores.shape[-1]:
        scores = scores.reshape(-1)
    energy = energies(scores)
    target = ratio.numerator * _by_row(jnp.sum, energy)

    def halve(bracket: _Bracket) -> _Bracket:
        middle = bracket.low + jax.lax.shift_right_logical(bracket.high - bracket.low, 1)
        chosen = scores >= _float(middle)
        number = _by_row(jnp.sum, chosen.astype(jnp.int32), dtype=jnp.int32)
        reached = _by_row(jnp.sum, jnp.where(chosen, energy, 0))
        is_low = ratio.denominator * reached >= target
        upper = bracket._replace(low=middle, num_low=number)
        lower = bracket._replace(high=middle, num_high=number)
        return jax.tree.map(functools.partial(jnp.where, is_low), upper, lower)

    lowest, highest = (_bits(_by_row(f, scores)) for f in (jnp.min, jnp.max))
    none = jnp.zeros_like(lowest)
    bracket = jax.lax.while_loop(
        lambda b: _any((b.high - b.low > 1) & (b.num_low - b.num_high > 1)),
        halve,
        _Bracket(lowest, highest + 1, none + scores.shape[-1], none),
    )
    # What is left in the bracket is one score, or ties.
    score = _by_row(jnp.max, jnp.where(scores <= _float(bracket.high - 1), scores, -1))
    find = functools.partial(_last_tie, scores, energy, score, target, ratio)
    several = _any(bracket.num_low - bracket.num_high > 1)
    last = jnp.where(target > 0, score, jnp.nan)
    return Boundary(last, jax.lax.cond(several, find, lambda: none + scores.shape[-1]))


def _last_tie(
    scores: jax.Array, energy: jax.Array, score: jax.Array, target: jax.Array, ratio: Ratio
) -> jax.Array:
    """Index of the last position of `score` that is needed, int32 [..., 1].

    Ties share one energy; one is kept while the energy before it falls short of the target.
    """
    above = _by_row(jnp.sum, jnp.where(scores > score, energy, 0))
    tied = scores == score
    each = _by_row(jnp.max, jnp.where(tied, energy, 0))
    position = jax.lax.broadcasted_iota(jnp.int32, scores.shape, scores.ndim - 1)
    num_bits = (scores.shape[-1] - 1).bit_length()

    def step(i: jax.Array, found: jax.Array) -> jax.Array:
        candidate = found | jax.lax.shift_left(jnp.int32(1), num_bits - 1 - i)
        before = _by_row(jnp.sum, (tied & (position < candidate)).astype(jnp.float32))
        falls_short = ratio.denominator * (above + before * each) < target
        return jnp.where(falls_short, candidate, found)

    return jax.lax.fori_loop(0, num_bits, step, jnp.zeros_like(score, jnp.int32))


def _any(condition: jax.Array) -> jax.Array:
    """Whether it holds in any row; Triton reduces numbers."""
    return condition.astype(jnp.int32).max() > 0
