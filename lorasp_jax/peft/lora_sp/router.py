"""LoRA-SP's router: eq. (10) of the paper (arXiv 2603.07404), and scores that tokens share.

All in fp32; `method` puts it together with gate, bank and losses.
"""

import functools
import math
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

Router = Literal["gelu", "gelu_relu", "gelu_softmax", "softmax"]
Granularity = Literal["token", "sample", "layer"]

SCORE_INIT_STD = 0.01
SOFTPLUS_INVERSE_OF_ONE = math.log(math.e - 1)
UNIT_LOGIT = {"gelu": SOFTPLUS_INVERSE_OF_ONE, "gelu_relu": 1.0, "gelu_softmax": 0.0}
"""The logit, the same for all directions, at which each router gives scores of 1."""

LARGEST_HIDDEN = 2.0**40
"""|x W1| from which on it counts as this much. A score grows with x, so the delta with its square:
beyond 1e19 it would exceed fp32, and U = 0 would make NaN of that."""

_RATIO = np.polynomial.Chebyshev.interpolate(lambda e: np.log1p(e) / e, 8, domain=[0, 1])
_LOG1P = _RATIO.convert(kind=np.polynomial.Polynomial).coef[::-1].tolist()
"""log(1 + e) / e for e in [0, 1] as a polynomial, highest power first; off by 4e-8."""


def init_scores(
    key: jax.Array, router: Router, hidden_width: int, rank: int
) -> dict[str, jax.Array]:
    """A router's second layer, w2 [H, R], and both bias vectors, if the router has biases.

    Scores of routers with biases start at 1. The second layer of a "softmax" router starts as the
    0/1 matrix that spreads H values over R directions.
    """
    if router == "softmax":
        value_of = np.arange(rank) * hidden_width // rank
        return {"w2": jnp.asarray(np.eye(hidden_width, dtype=np.float32)[:, value_of])}
    return {
        "b1": jnp.zeros(hidden_width),
        "w2": SCORE_INIT_STD * jax.random.normal(key, (hidden_width, rank)),
        "b2": jnp.full(rank, UNIT_LOGIT[router], jnp.float32),
    }


def router_scores(
    router: dict[str, jax.Array], hidden: jax.Array, kind: Router
) -> tuple[jax.Array, jax.Array]:
    """Eq. (10): h = φ(x W1 + b1), s(x) = h W2 + b2 made non-negative.

    With biases φ is GELU, and softplus ("gelu"), ReLU, or R times the softmax over the R directions
    makes the scores non-negative. Without ("softmax") φ is softmax, whose product with a 0/1 matrix
    is non-negative at the start; ReLU keeps it so.

    Args:
      router: w2 [H, R], and b1 [H], b2 [R] if there are biases.
      hidden: x W1, [..., H]; everything from here on is in fp32.
      kind: which of these.

    Returns:
      scores f32 [..., R], and the logits the z-loss acts on: the last nonlinearity's input [..., R]
      or the softmax' input [..., H].
    """
    hidden = bounded(hidden)
    if kind == "softmax":
        return jax.nn.relu(jax.nn.softmax(hidden) @ router["w2"]), hidden
    logits = _product(gelu(hidden + router["b1"]), router["w2"]) + router["b2"]
    if kind == "gelu_softmax":
        return logits.shape[-1] * jax.nn.softmax(logits), logits
    return (softplus if kind == "gelu" else jax.nn.relu)(logits), logits


def bounded(hidden: jax.Array) -> jax.Array:
    """x W1 in fp32, in ±LARGEST_HIDDEN: scores, losses and gradients stay finite where x does."""
    return clipped(hidden.astype(jnp.float32), LARGEST_HIDDEN)


def clipped(x: jax.Array, largest: float) -> jax.Array:
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
