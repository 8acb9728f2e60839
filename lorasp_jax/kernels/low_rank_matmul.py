"""x W + f(x P) U with W frozen, for one layer or several that read the same x.

P [I, Q] reads the input, U [R, O] writes the output, and f, small, works on rows in between. The
reference is that formula. The function here computes the same and differs in what the products
cost, since at these sizes each pass over a wide array takes as long as the adapter itself:

- no gradient is ever computed for W;
- the P of all layers are one product with x, and in the backward pass one more gives their
  gradients and one the gradient of x through them;
- where the output is at least as wide as the input, x W + z U is one product, [x, z] [W; U];
- where it is far wider, so are g Wᵀ and g Uᵀ of the gradient g of y, g [W; U]ᵀ;
- where the input is at least as wide as the outputs, the gradient of x is one product,
  [g, q] [W, P]ᵀ with q the gradient of x P.

The last three only where there are more tokens than inputs: for few, the copy of W is what costs;
and not on a CPU, which multiplies both as fast and takes three times as long to compile the copies.
W is cast to the type of x in each pass and kept between them as it came, so a quantised one is not
widened in memory for long.
"""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.platform import platform
from lorasp_jax.kernels.quantized_weights import QuantizedKernel


class Bottleneck(Protocol):
    """f of one layer."""

    def bottleneck(
        self, params: Any, rows: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Any]:
        """z [..., R] and a pytree, from rows [..., Q]."""
        ...


class BottleneckEach(Protocol):
    """f of several layers that are computed in one go."""

    def bottleneck_each(
        self,
        params: Sequence[Any],
        projected: jax.Array,
        widths: Sequence[int],
        token_mask: jax.Array | None,
    ) -> list[tuple[jax.Array, Any]]:
        """z and a pytree of each layer.

        Args:
          params: of each layer.
          projected: the rows of all layers side by side, with perhaps more columns behind.
          widths: Q of each layer.
          token_mask: bool [...tokens] or None.
        """
        ...


Methods = tuple[Bottleneck, ...] | BottleneckEach


class LowRankLayer(NamedTuple):
    """What multiplies the common input."""

    params: Any
    """What f needs."""
    kernel: jax.Array | QuantizedKernel | Any
    """W [I, O] of any type, frozen: its cotangent is zero by definition."""
    down: jax.Array
    """P [I, Q], fp32, used in the type of x."""
    up: jax.Array
    """U [R, O], fp32, used in the type of x."""


# Traced and lowered once for all equal layers of a model.
@functools.partial(jax.jit, static_argnums=(0, 1))
@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def low_rank_matmul(
    methods: Methods,
    rows_dtype: Any,
    layers: Sequence[LowRankLayer],
    x: jax.Array,
    token_mask: jax.Array | None,
) -> list[tuple[jax.Array, Any]]:
    """Of each layer x W + z U in the type of x and aux, with z, aux = f(params, x P, token_mask).

    Args:
      methods: f of each layer, or of all; hashable, and equal ones are taken to do the same.
      rows_dtype: type of the rows, which are summed in fp32.
      layers: arrays of each layer.
      x: [..., I].
      token_mask: handed to each f.
    """
    params, widths = [layer.params for layer in layers], _widths(layers)
    projected = jnp.matmul(x, _side_by_side(layers, x), preferred_element_type=rows_dtype)
    if isinstance(methods, tuple):
        each = zip(methods, params, _split(widths, projected), strict=True)
        written = [method.bottleneck(own, rows, token_mask) for method, own, rows in each]
    else:
        written = methods.bottleneck_each(params, projected, widths, token_mask)
    return [
        (two_products(x, z, layer.kernel, layer.up), aux)
        for layer, (z, aux) in zip(layers, written, strict=True)
    ]


def _forward(
    methods: Methods,
    rows_dtype: Any,
    layers: Sequence[LowRankLayer],
    x: jax.Array,
    token_mask: jax.Array | None,
) -> tuple:
    """`low_rank_matmul`, and what its gradient needs."""
    widths = _widths(layers)
    projected = jnp.matmul(x, _side_by_side(layers, x), preferred_element_type=rows_dtype)

    def inner(params: list[Any], projected: jax.Array) -> list[tuple[jax.Array, Any]]:
        if isinstance(methods, tuple):
            each = zip(methods, params, _split(widths, projected), strict=True)
            found = [method.bottleneck(own, rows, token_mask) for method, own, rows in each]
        else:
            found = methods.bottleneck_each(params, projected, widths, token_mask)
        return [(z.astype(x.dtype), aux) for z, aux in found]

    written, pull_back = jax.vjp(inner, [layer.params for layer in layers], projected)
    found = [
        (two_products(x, z, layer.kernel, layer.up), aux)
        for layer, (z, aux) in zip(layers, written, strict=True)
    ]
    return found, (layers, x, pull_back, [z for z, _ in written])


def two_products(
    x: jax.Array, z: jax.Array, kernel: jax.Array | QuantizedKernel, up: jax.Array
) -> jax.Array:
    """x W + z U, [..., O], in the type of x [..., I], of z [..., R]."""
    w, u, z = kernel.astype(x.dtype), up.astype(x.dtype), z.astype(x.dtype)
    d_in, d_out = w.shape
    if d_out >= d_in and _joins(w, x):
        return jnp.concatenate([x, z], axis=-1) @ jnp.concatenate([w, u])
    return x @ w + z @ u


def _backward(
    methods: Methods, rows_dtype: Any, residuals: tuple, cotangents: Sequence[tuple]
) -> tuple:
    del methods, rows_dtype
    layers, x, pull_back, written = residuals
    gradients = [g for g, _ in cotangents]
    through_bases, d_written = [], []
    for layer, (g, d_aux) in zip(layers, cotangents, strict=True):
        d_in, d_out = layer.kernel.shape
        w, u = layer.kernel.astype(x.dtype), layer.up.astype(x.dtype)
        through_base, dz = None, None
        if d_out > 2 * d_in and _joins(w, x):
            through_base, dz = jnp.split(g @ jnp.concatenate([w, u]).T, [d_in], axis=-1)
        through_bases.append(through_base)
        d_written.append((g @ u.T if dz is None else dz, d_aux))
    d_params, d_projected = pull_back(d_written)
    q = d_projected.astype(x.dtype)
    dx = _gradient_of_input(layers, x, gradients, through_bases, q)
    d_downs = _split(_widths(layers), _outer(x, q, layers[0].down.dtype))
    d_layers = [
        LowRankLayer(of_params, None, d_down, _outer(z, g, layer.up.dtype))
        for layer, of_params, d_down, z, g in zip(
            layers, d_params, d_downs, written, gradients, strict=True
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
    """Σ g Wᵀ + q Pᵀ, [..., I]; `through_bases` holds those g Wᵀ that are there already."""
    p = _side_by_side(layers, x)
    w = [layer.kernel.astype(x.dtype) for layer in layers]
    if sum(g.shape[-1] for g in gradients) <= x.shape[-1] and _joins(w[0], x):
        return jnp.concatenate([*gradients, q], axis=-1) @ jnp.concatenate([*w, p], axis=1).T
    dx = q @ p.T
    for g, kernel, through_base in zip(gradients, w, through_bases, strict=True):
        dx += g @ kernel.T if through_base is None else through_base
    return dx


def _joins(w: jax.Array, x: jax.Array) -> bool:
    """Whether copying W next to U costs less than it saves: so many tokens, and no CPU."""
    return math.prod(x.shape[:-1]) >= w.shape[0] and platform() != "cpu"


def _side_by_side(layers: Sequence[LowRankLayer], x: jax.Array) -> jax.Array:
    """The P of all layers, [I, ΣQ], in the type of x."""
    return aligned(jnp.concatenate([layer.down.astype(x.dtype) for layer in layers], axis=1))


def _widths(layers: Sequence[LowRankLayer]) -> list[int]:
    """Q of each."""
    return [layer.down.shape[1] for layer in layers]


def _split(widths: Sequence[int], columns: jax.Array) -> list[jax.Array]:
    """Each layer's share [..., Q] of columns [..., ΣQ or more]."""
    return jnp.split(columns, list(itertools.accumulate(widths)), axis=-1)[:-1]


def aligned(matrix: jax.Array) -> jax.Array:
    """Zeros up to a multiple of 8 columns: 132 made LoRA-MoE's backward pass twice as long."""
    return jnp.pad(matrix, [(0, 0)] * (matrix.ndim - 1) + [(0, -matrix.shape[-1] % 8)])


def _outer(left: jax.Array, right: jax.Array, dtype: Any) -> jax.Array:
    """Sum over all tokens of the outer products of left [..., M] and right [..., N], [M, N]."""
    return jnp.einsum("...m,...n->mn", left, right, preferred_element_type=dtype)


low_rank_matmul.__wrapped__.defvjp(_forward, _backward)
