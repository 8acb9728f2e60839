"""LoRA-SP's router: eq. (10) of the paper (arXiv 2603.07404), in fp32."""

import functools
import math
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

RouterKind = Literal["gelu", "gelu_relu", "gelu_softmax", "softmax"]

SCORE_INIT_STD = 0.01
INVERSE_SOFTPLUS_OF_ONE = math.log(math.e - 1)
INITIAL_LOGIT = {"gelu": INVERSE_SOFTPLUS_OF_ONE, "gelu_relu": 1.0, "gelu_softmax": 0.0}
"""Initial output bias of every direction, by router; a logit of this value yields a score of 1."""

MAX_PROJECTED = 2.0**40
"""Bound to which |x W1| is clipped. z grows quadratically with x. Without the bound, it would
overflow fp32 to infinity for x beyond 1e19, and U = 0 would turn that infinity into NaN."""

_RATIO = np.polynomial.Chebyshev.interpolate(lambda e: np.log1p(e) / e, 8, domain=[0, 1])
_LOG1P = _RATIO.convert(kind=np.polynomial.Polynomial).coef[::-1].tolist()
"""log(1 + e) / e for e in [0, 1] as a polynomial, highest power first; maximum error 4e-8."""


def init_output_layer(
    key: jax.Array, router: RouterKind, hidden_width: int, rank: int
) -> dict[str, jax.Array]:
    """Initialize the router's second layer w2 [H, R], and its biases b1 [H], b2 [R] if it has any.

    Routers with biases start with scores close to 1. The second layer of a "softmax" router starts
    as a 0/1 matrix that assigns one of the H hidden units to each of the R directions.
    """
    if router == "softmax":
        assignment = np.arange(rank) * hidden_width // rank
        return {"w2": jnp.asarray(np.eye(hidden_width, dtype=np.float32)[:, assignment])}
    return {
        "b1": jnp.zeros(hidden_width),
        "w2": SCORE_INIT_STD * jax.random.normal(key, (hidden_width, rank)),
        "b2": jnp.full(rank, INITIAL_LOGIT[router], jnp.float32),
    }


def router_scores(
    router: dict[str, jax.Array],
    hidden: jax.Array,
    kind: RouterKind,
    matmul: Callable[[jax.Array, jax.Array], jax.Array] = jnp.matmul,
) -> tuple[jax.Array, jax.Array]:
    """Eq. (10): h = φ(x W1 + b1), s(x) = ψ(h W2 + b2) with a non-negative ψ.

    For "gelu", "gelu_relu" and "gelu_softmax", φ is GELU and ψ is softplus, ReLU or R times the
    softmax over directions. "softmax" has no biases; φ is softmax and ψ is ReLU. With the initial
    0/1 matrix W2, this ReLU has no effect. With a trained W2, it keeps the scores non-negative.
    The GPU kernel traces this function too, so it uses only operations that Triton supports.

    Args:
        router: w2 [H, R], and b1 [H], b2 [R] unless `kind` is "softmax".
        hidden: x W1, [..., H] of any dtype.
        kind: the router variant.
        matmul: multiplies by W2, unless `kind` is "softmax".

    Returns:
        scores f32 [..., R], and the logits for the z-loss: the input of ψ [..., R], or that of φ
        [..., H] if `kind` is "softmax".
    """
    hidden = cast_and_clip(hidden)
    if kind == "softmax":
        return jax.nn.relu(jax.nn.softmax(hidden) @ router["w2"]), hidden
    logits = matmul(gelu(hidden + router["b1"]), router["w2"]) + router["b2"]
    if kind == "gelu_softmax":
        return logits.shape[-1] * jax.nn.softmax(logits), logits
    return (softplus if kind == "gelu" else jax.nn.relu)(logits), logits


def cast_and_clip(hidden: jax.Array) -> jax.Array:
    """Cast x W1 to fp32, clipped so that scores, losses and gradients are finite for finite x."""
    return clip(hidden.astype(jnp.float32), MAX_PROJECTED)


def clip(x: jax.Array, limit: float) -> jax.Array:
    """Clip x to ±`limit` and propagate NaN, which minimum and maximum do not in Triton."""
    return jnp.where(x > limit, limit, jnp.where(x < -limit, -limit, x))


def gelu(x: jax.Array) -> jax.Array:
    """The tanh approximation of `jax.nn.gelu`, x (1 + tanh u) / 2, computed as x sigmoid(2 u)."""
    return x * jax.nn.sigmoid(2 * math.sqrt(2 / math.pi) * (x + 0.044715 * x * x * x))


@jax.custom_jvp
def softplus(x: jax.Array) -> jax.Array:
    """log(1 + e^x) in few instructions, relative error 3e-7.

    The instruction count limits the speed of the fused GPU kernel. With `jax.nn.softplus` and
    `jax.nn.gelu`, its gradient has 25 % more PTX instructions (H200).
    """
    e = jnp.exp(-jnp.abs(x))
    first, *others = _LOG1P
    ratio = functools.reduce(lambda total, c: total * e + c, others, jnp.full_like(x, first))
    return jnp.maximum(x, 0) + e * ratio


@softplus.defjvp
def _(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    (x,), (tangent,) = primals, tangents
    e = jnp.exp(-jnp.abs(x))
    return softplus(x), tangent * jnp.where(x < 0, e, 1) / (1 + e)
