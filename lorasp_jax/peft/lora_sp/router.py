"""LoRA-SP's router: its scores, how scores of several tokens are pooled, and its losses.

One function per equation of the paper (arXiv 2603.07404), all in fp32; `method` puts them together.
Padding stays out of everything that is summed over tokens.
"""

import dataclasses
import functools
import math
from collections.abc import Iterator, Mapping
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.kernels.energy_gate import (
    Implementation,
    energy_gate,
    energy_share,
    kept_energy,
)

Router = Literal["gelu", "softmax", "linear"]
ScoreFunction = Literal["softplus", "relu", "softmax"]
Granularity = Literal["token", "sample", "layer"]

Routed = tuple[jax.Array, Mapping[str, jax.Array], jax.Array, list[jax.Array]]
"""z, losses, how often each direction was kept, and active rank and kept energy by token."""

SCORE_INIT_STD = 0.01
SOFTPLUS_INVERSE_OF_ONE = math.log(math.e - 1)
UNIT_LOGIT: dict[str, float] = {"softplus": SOFTPLUS_INVERSE_OF_ONE, "relu": 1.0, "softmax": 0.0}
"""The logit, the same for all directions, at which each score function gives 1."""

LARGEST_HIDDEN = 2.0**40
"""|x W1| from which on it counts as this much. A score grows with x, so the delta with its square:
beyond 1e19 it would exceed fp32, and U = 0 would make NaN of that."""
LARGEST_READ = 2.0**120
"""The same for z, which leaves its sum over a bank room below 2^128."""

_RATIO = np.polynomial.Chebyshev.interpolate(lambda e: np.log1p(e) / e, 8, domain=[0, 1])
_LOG1P = _RATIO.convert(kind=np.polynomial.Polynomial).coef[::-1].tolist()
"""log(1 + e) / e for e in [0, 1] as a polynomial, highest power first; off by 4e-8."""


def init_scores(
    key: jax.Array, router: Router, score_function: ScoreFunction, hidden_width: int, rank: int
) -> dict[str, jax.Array]:
    """A router's second layer, w2 [H, R], and the biases of both; what it has of them."""
    if router == "linear":
        return {}
    if router == "softmax":
        return {"w2": jnp.repeat(jnp.eye(hidden_width), rank // hidden_width, axis=1)}
    return {
        "b1": jnp.zeros(hidden_width),
        "w2": SCORE_INIT_STD * jax.random.normal(key, (hidden_width, rank)),
        "b2": jnp.full(rank, UNIT_LOGIT[score_function], jnp.float32),
    }


def route(
    router: dict[str, jax.Array],
    columns: list[jax.Array],
    counts: jax.Array,
    kept: jax.Array | None,
    *,
    energy_target: float,
    scale: float,
    gate: Implementation | None,
    score_function: ScoreFunction = "softplus",
) -> tuple[jax.Array, "LossSums", jax.Array, list[jax.Array]]:
    """Everything between the two matrix products with the bank, row by row.

    Args:
      router: w2 [H, R], and b1 [H], b2 [R] or none.
      columns: V x [n, R] and W1 x [n, H] in one type.
      counts: bool [n, 1], False for padding.
      kept: bool [n, R], the gate's mask where it is known already; it has no gradient.
      energy_target: η.
      scale: α/R.
      gate: implementation of the energy gate, None: the backend's default.
      score_function: of a router with biases.

    Returns:
      z [n, R], the losses' sums over rows, the mask, and f32 [n, 1] each active rank and kept
      energy.
    """
    projected, hidden = columns
    scores, logits = router_scores(router, hidden, score_function)
    mask = energy_gate(scores, energy_target, implementation=gate)[0] if kept is None else kept
    energy = kept_energy(scores, mask)[:, None]
    z = select(projected, scale * scores, mask, energy)
    active_rank = mask.astype(jnp.float32).sum(-1, keepdims=True)
    return z, loss_sums(scores, logits, mask, energy, counts), mask, [active_rank, energy]


def router_scores(
    router: dict[str, jax.Array], hidden: jax.Array, score_function: ScoreFunction = "softplus"
) -> tuple[jax.Array, jax.Array]:
    """Eq. (10): h = φ(x W1 + b1), s(x) = h W2 + b2 made non-negative.

    With biases φ is GELU and a score function makes the scores non-negative: softplus, ReLU, or R
    times the softmax over the R directions. Without, φ is softmax, whose product with a 0/1 matrix
    is non-negative at the start; ReLU keeps it so.

    Args:
      router: w2 [H, R] and b1 [H], b2 [R] or none.
      hidden: x W1, [..., H]; everything from here on is in fp32.
      score_function: of a router with biases.

    Returns:
      scores f32 [..., R], and the logits the z-loss acts on: the score function's input [..., R] or
      the softmax' input [..., H].
    """
    hidden = bounded(hidden)
    if "b1" not in router:
        return jax.nn.relu(jax.nn.softmax(hidden) @ router["w2"]), hidden
    logits = _product(gelu(hidden + router["b1"]), router["w2"]) + router["b2"]
    if score_function == "softmax":
        return logits.shape[-1] * jax.nn.softmax(logits), logits
    return (softplus if score_function == "softplus" else jax.nn.relu)(logits), logits


def bounded(hidden: jax.Array) -> jax.Array:
    """x W1 in fp32, in ±LARGEST_HIDDEN: scores, losses and gradients stay finite where x does."""
    return _clipped(hidden.astype(jnp.float32), LARGEST_HIDDEN)


def _clipped(x: jax.Array, largest: float) -> jax.Array:
    """x in ±`largest`, and NaN where x is, which minimum and maximum pass over in Triton."""
    return jnp.where(x > largest, largest, jnp.where(x < -largest, -largest, x))


def gelu(x: jax.Array) -> jax.Array:
    """x (1 + tanh u) / 2, the approximation of `jax.nn.gelu`, as x sigmoid(2 u)."""
    return x * jax.nn.sigmoid(2 * math.sqrt(2 / math.pi) * (x + 0.044715 * x * x * x))


@jax.custom_jvp
def softplus(x: jax.Array) -> jax.Array:
    """log(1 + e^x), to 3e-7 of it, for a kernel that is as fast as its instructions are few.

    With those of `jax.nn` for this and `gelu` its gradient has a quarter more (PTX for an H200).
    """
    small = jnp.exp(-jnp.abs(x))
    first, *others = _LOG1P
    ratio = functools.reduce(lambda total, c: total * small + c, others, jnp.full_like(x, first))
    return jnp.maximum(x, 0) + small * ratio


@softplus.defjvp
def _(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    (x,), (tangent,) = primals, tangents
    small = jnp.exp(-jnp.abs(x))
    return softplus(x), tangent * jnp.where(x < 0, small, 1) / (1 + small)


def _product(rows: jax.Array, matrix: jax.Array) -> jax.Array:
    """rows @ matrix, [n, R]; of one row a sum, as Triton's matrix product takes 16 or more."""
    if rows.shape[:-1] != (1,):
        return rows @ matrix
    return (rows.reshape(-1, 1) * matrix).sum(0, keepdims=True)


def pooled_scores(scores: jax.Array, valid: jax.Array, granularity: Granularity) -> jax.Array:
    """Scores whose squares are the mean squares over the tokens that share one mask.

    So a set of directions that reaches η of the pooled energy holds η of the energy of all valid
    tokens of its sample or layer together, though perhaps not of each.

    Args:
      scores: f32 [...tokens, R].
      valid: bool [...tokens], False for padding.
      granularity: "sample": the last token axis is pooled. "layer": all of them, the whole batch.

    Returns:
      [...tokens, R] with 1 for each pooled axis; scores without a token axis as they are.
    """
    if granularity == "token" or scores.ndim == 1:
        return scores
    scores = jax.lax.stop_gradient(scores)  # of no use to a mask, and infinite at zero
    axes = (scores.ndim - 2,) if granularity == "sample" else tuple(range(scores.ndim - 1))
    valid = valid[..., None]
    total = jnp.where(valid, jnp.square(scores), 0).sum(axes, keepdims=True)
    return jnp.sqrt(total / jnp.maximum(valid.sum(axes, keepdims=True), 1))


def select(
    projected: jax.Array, scores: jax.Array, mask: jax.Array, energy: jax.Array
) -> jax.Array:
    """Eq. (11): Σ(x) V x with the pruned scores at zero, in the type of `projected` [..., n].

    Scores and mask may be wider; what is beyond n has no direction any more. NaN scores keep no
    direction, and show all the same: a row whose energy [..., 1] is NaN is all NaN.
    """
    here, dtype = projected.shape[-1], projected.dtype
    if here < scores.shape[-1]:
        scores, mask = scores[..., :here], mask[..., :here]
    largest = min(LARGEST_READ, float(jnp.finfo(dtype).max))
    product = _clipped(projected.astype(jnp.float32) * scores, largest)
    return jnp.where(mask, product, 0 * jax.lax.stop_gradient(energy)).astype(dtype)


class LossSums(NamedTuple):
    """What the auxiliary losses need, summed over the valid rows: f32 [1], kept and share [R]."""

    rows: jax.Array
    spectral: jax.Array
    """1 - E_k."""
    z: jax.Array
    """Squared mean logit, on the scale of exponentials."""
    kept: jax.Array
    """1 for each kept direction; no gradient."""
    share: jax.Array
    """Share of the energy."""


def loss_sums(
    scores: jax.Array, logits: jax.Array, mask: jax.Array, energy: jax.Array, counts: jax.Array
) -> LossSums:
    """The sums for scores and mask [n, R], logits [n, :], kept energy and counts [n, 1].

    A row of zeros is not valid: it teaches the router nothing. NaN shows in the sums.
    """
    valid = (scores.max(-1, keepdims=True) != 0) & counts
    mean_logit = jax.nn.logsumexp(logits, axis=-1, keepdims=True) - math.log(logits.shape[-1])

    def total(values: jax.Array) -> jax.Array:
        return jnp.where(valid, values, 0).sum(0)

    return LossSums(
        rows=total(jnp.ones_like(energy)),
        spectral=total(1 - energy),
        z=total(jnp.square(mean_logit)),
        kept=total(mask.astype(jnp.float32)),
        share=total(energy_share(scores)),
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Losses(Mapping[str, jax.Array]):
    """The auxiliary losses of eq. (14) by name, f32, of one layer or of several, [L].

    They are computed where they are asked for: of stacked layers all at once, not in each layer in
    a dozen steps on a few numbers.
    """

    sums: LossSums
    """[L, ...] for several layers."""

    def __getitem__(self, name: str) -> jax.Array:
        return _LOSSES[name](self.sums)

    def __iter__(self) -> Iterator[str]:
        return iter(_LOSSES)

    def __len__(self) -> int:
        return len(_LOSSES)


@jax.jit
def spectral_loss(sums: LossSums) -> jax.Array:
    """Eq. (13): 1 - E_k, averaged over valid rows."""
    return _mean(sums.spectral, sums)


@jax.jit
def balance_loss(sums: LossSums) -> jax.Array:
    """Balance term of eq. (14): R Σ_i f_i P_i, 1 where all directions are used alike.

    The load-balancing loss of Fedus et al. (arXiv 2101.03961, eq. 4) for k(x) choices a token: f_i
    is direction i's share of all kept places (no gradient), P_i its mean share of the energy.
    """
    kept = jax.lax.stop_gradient(sums.kept)
    used = kept / jnp.maximum(kept.sum(-1, keepdims=True), 1)
    return kept.shape[-1] * _mean(jnp.sum(used * sums.share, -1, keepdims=True), sums)


@jax.jit
def z_loss(sums: LossSums) -> jax.Array:
    """z term of eq. (14): (logsumexp(logits) - ln n)², n = logits' width, over valid rows.

    Zoph et al. (arXiv 2202.08906, eq. 5) without the ln n, which would push the logits of a wide
    router down even where they are all zero.
    """
    return _mean(sums.z, sums)


_LOSSES = {"spectral": spectral_loss, "balance": balance_loss, "z": z_loss}


def _mean(total: jax.Array, sums: LossSums) -> jax.Array:
    return total[..., 0] / jnp.maximum(sums.rows[..., 0], 1)
