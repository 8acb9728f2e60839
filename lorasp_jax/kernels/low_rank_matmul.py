"""Compute x W + f(x P) U with W frozen, for one layer or several that share the input x.

P [I, Q] projects the input down, U [R, O] projects up, and f is a small function of each token's
row of x P. That formula is the reference. At these sizes each pass over a wide array costs as much
as the adapter itself, so the implementation saves matrix products:

- No gradient is ever computed for W.
- All layers' P multiply x in one product. The backward pass takes one more for the gradients of all
  P, and one for the gradient of x through them.
- If the output is at least as wide as the input, x W + z U is one product, [x, z] [W; U].
- If it is more than twice as wide, g Wᵀ and g Uᵀ are one product too, g [W; U]ᵀ, with g the
  gradient of y.
- If the input is at least as wide as all outputs, the gradient of x is one product, [g, q] [W, P]ᵀ,
  with q the gradient of x P.

The last three apply only if there are at least as many tokens as inputs, since copying W dominates
for few tokens; and never on CPU, where they run no faster and take three times as long to compile.
W is cast to the dtype of x in each pass but stored as given, so a quantised W is never expanded in
memory for long.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.quantized_kernel import QuantizedKernel

LayerFunction = Callable[[Any, jax.Array, jax.Array | None], tuple[jax.Array, Any]]
"""f of one layer: (params, rows [..., Q], token_mask) -> z [..., R] and aux, a pytree."""
InnerFunction = Callable[
    [Sequence[Any], jax.Array, Sequence[int], jax.Array | None], list[tuple[jax.Array, Any]]
]
"""f of all layers: (params of each, rows [..., ΣQ or more], widths Q, token_mask) -> (z, aux) of
each. The rows of all layers are adjacent columns; padding columns may follow."""


class LowRankLayer(NamedTuple):
    """The arrays of one layer."""

    params: Any
    """Parameters of f."""
    kernel: jax.Array | QuantizedKernel | Any
    """W [I, O] of any dtype, frozen: its cotangent is zero by definition."""
    down: jax.Array
    """P [I, Q], fp32, cast to the dtype of x."""
    up: jax.Array
    """U [R, O], fp32, cast to the dtype of x."""


def one_by_one(functions: Sequence[LayerFunction]) -> InnerFunction:
    """Apply each layer's f to its own columns."""

    def inner(
        params: Sequence[Any],
        projected: jax.Array,
        widths: Sequence[int],
        token_mask: jax.Array | None,
    ) -> list[tuple[jax.Array, Any]]:
        rows = _split(widths, projected)
        return [f(p, r, token_mask) for f, p, r in zip(functions, params, rows, strict=True)]

    return inner


# jit, so that all equal layers of a model are traced and lowered once.
@functools.partial(jax.jit, static_argnums=(0, 1))
def low_rank_matmul(
    inner: InnerFunction,
    rows_dtype: Any,
    layers: Sequence[LowRankLayer],
    x: jax.Array,
    token_mask: jax.Array | None,
) -> list[tuple[jax.Array, Any]]:
    """Compute y = x W + z U and aux for each layer, with z, aux = f(params, x P, token_mask).

    Args:
      inner: f of all layers, hashable; functions that compare equal must compute the same.
      rows_dtype: dtype of x P, which is accumulated in fp32.
      layers: arrays of each layer.
      x: [..., I].
      token_mask: bool [...] or None, passed to f.

    Returns:
      (y [..., O] in the dtype of x, aux) for each layer.
    """
    return _product(inner, rows_dtype, layers, x, token_mask)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _product(
    inner: InnerFunction,
    rows_dtype: Any,
    layers: Sequence[LowRankLayer],
    x: jax.Array,
    token_mask: jax.Array | None,
) -> list[tuple[jax.Array, Any]]:
    return _forward(inner, rows_dtype, layers, x, token_mask)[0]


def _forward(
    inner: InnerFunction,
    rows_dtype: Any,
    layers: Sequence[LowRankLayer],
    x: jax.Array,
    token_mask: jax.Array | None,
) -> tuple:
    projected = jnp.matmul(x, _joined_down(layers, x), preferred_element_type=rows_dtype)

    def differentiable(params: list[Any], projected: jax.Array) -> list[tuple[jax.Array, Any]]:
        results = inner(params, projected, _widths(layers), token_mask)
        return [(z.astype(x.dtype), aux) for z, aux in results]

    rows, pull_back = jax.vjp(differentiable, [layer.params for layer in layers], projected)
    outputs = []
    for layer, (z, aux) in zip(layers, rows, strict=True):
        y = two_products(x, z, layer.kernel.astype(x.dtype), layer.up.astype(x.dtype))
        outputs.append((y, aux))
    return outputs, (layers, x, pull_back, [z for z, _ in rows])


def two_products(x: jax.Array, z: jax.Array, w: jax.Array, u: jax.Array) -> jax.Array:
    """Compute x W + z U, [..., O], from x [..., I] and z [..., R], in one product where faster."""
    d_in, d_out = w.shape
    if d_out >= d_in and _worth_joining(w, x):
        return jnp.concatenate([x, z], axis=-1) @ jnp.concatenate([w, u])
    return x @ w + z @ u


def _backward(
    inner: InnerFunction, rows_dtype: Any, residuals: tuple, cotangents: Sequence[tuple]
) -> tuple:
    del inner, rows_dtype
    layers, x, pull_back, rows = residuals
    gradients = [g for g, _ in cotangents]
    through_bases, d_rows = [], []
    for layer, (g, d_aux) in zip(layers, cotangents, strict=True):
        d_in, d_out = layer.kernel.shape
        w, u = layer.kernel.astype(x.dtype), layer.up.astype(x.dtype)
        through_base, dz = None, None
        if d_out > 2 * d_in and _worth_joining(w, x):
            through_base, dz = jnp.split(g @ jnp.concatenate([w, u]).T, [d_in], axis=-1)
        through_bases.append(through_base)
        d_rows.append((g @ u.T if dz is None else dz, d_aux))
    d_params, d_projected = pull_back(d_rows)
    q = d_projected.astype(x.dtype)
    dx = _gradient_of_input(layers, x, gradients, through_bases, q)
    d_downs = _split(_widths(layers), _outer(x, q, layers[0].down.dtype))
    d_layers = [
        LowRankLayer(own_params, None, d_down, _outer(z, g, layer.up.dtype))
        for layer, own_params, d_down, z, g in zip(
            layers, d_params, d_downs, rows, gradients, strict=True
        )
    ]
    return d_layers, dx, None


def _gradient_of_input(
    layers: Sequence[LowRankLayer],
    x: jax.Array,
    gradients: Sequence[jax.Array],
    through_bases: Sequence[jax.Array | None],
    q: jax.Array,
) -> jax.Array:
    """Compute Σ g Wᵀ + q Pᵀ, [..., I]; `through_bases` holds each known g Wᵀ, else None."""
    p = _joined_down(layers, x)
    w = [layer.kernel.astype(x.dtype) for layer in layers]
    if sum(g.shape[-1] for g in gradients) <= x.shape[-1] and _worth_joining(w[0], x):
        return jnp.concatenate([*gradients, q], axis=-1) @ jnp.concatenate([*w, p], axis=1).T
    dx = q @ p.T
    for g, kernel, through_base in zip(gradients, w, through_bases, strict=True):
        dx += g @ kernel.T if through_base is None else through_base
    return dx


def _worth_joining(w: jax.Array, x: jax.Array) -> bool:
    """Return whether joining W and U saves more than the copy costs: many tokens, not on CPU."""
    return math.prod(x.shape[:-1]) >= w.shape[0] and jax.default_backend() != "cpu"


def _joined_down(layers: Sequence[LowRankLayer], x: jax.Array) -> jax.Array:
    """Concatenate the P of all layers, [I, ΣQ padded to 8], in the dtype of x."""
    return aligned(jnp.concatenate([layer.down.astype(x.dtype) for layer in layers], axis=1))


def _widths(layers: Sequence[LowRankLayer]) -> list[int]:
    """Return Q of each layer."""
    return [layer.down.shape[1] for layer in layers]


def _split(widths: Sequence[int], columns: jax.Array) -> list[jax.Array]:
    """Split columns [..., ΣQ or more] into each layer's [..., Q]."""
    return jnp.split(columns, list(itertools.accumulate(widths)), axis=-1)[:-1]


def aligned(matrix: jax.Array) -> jax.Array:
    """Pad to a multiple of 8 columns: with 132, LoRA-MoE's backward pass took twice as long."""
    return jnp.pad(matrix, [(0, 0)] * (matrix.ndim - 1) + [(0, -matrix.shape[-1] % 8)])


def _outer(left: jax.Array, right: jax.Array, dtype: Any) -> jax.Array:
    """Sum the outer products of left [..., M] and right [..., N] over all tokens, [M, N]."""
    return jnp.einsum("...m,...n->mn", left, right, preferred_element_type=dtype)


_product.defvjp(_forward, _backward)
