"""x W + f(x P) U with W frozen: the matrix products under every low-rank adapter.

P [I, Q] reads the input, U [R, O] writes the output, and f, small, works on rows in between. The
reference is that formula. The function here computes the same and differs in what the products
cost, since at these sizes each pass over a wide array takes as long as the adapter itself:

- no gradient is ever computed for W;
- where the output is at least as wide as the input, x W + z U is one product, [x, z] [W; U];
- where it is far wider, so are g Wᵀ and g Uᵀ of the gradient g of y, g [W; U]ᵀ;
- where the input is at least as wide as the output, the gradient of x is one product,
  [g, q] [W, P]ᵀ with q the gradient of x P.

W is cast to the type of x in each pass and kept between them as it came, so a quantised one is not
widened in memory for long.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.quantized import QuantizedKernel

Between = Callable[[Any, jax.Array, jax.Array | None], tuple[jax.Array, Any]]


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def low_rank_matmul(
    between: Between,
    rows_dtype: Any,
    params: Any,
    x: jax.Array,
    kernel: jax.Array | QuantizedKernel,
    down: jax.Array,
    up: jax.Array,
    token_mask: jax.Array | None,
) -> tuple[jax.Array, Any]:
    """x W + z U in the type of x and aux, with z, aux = between(params, x P, token_mask).

    Args:
      between: f. It gets rows [..., Q] and returns z [..., R] and a pytree.
      rows_dtype: type of the rows, which are summed in fp32.
      params: what f needs.
      x: [..., I].
      kernel: W [I, O] of any type, frozen: its cotangent is zero by definition.
      down: P [I, Q], fp32, used in the type of x.
      up: U [R, O], fp32, used in the type of x.
      token_mask: handed to f.
    """
    return _forward(between, rows_dtype, params, x, kernel, down, up, token_mask)[0]


def _forward(
    between: Between,
    rows_dtype: Any,
    params: Any,
    x: jax.Array,
    kernel: jax.Array | QuantizedKernel,
    down: jax.Array,
    up: jax.Array,
    token_mask: jax.Array | None,
) -> tuple:
    p = _aligned(down.astype(x.dtype))
    rows = jnp.matmul(x, p, preferred_element_type=rows_dtype)[..., : down.shape[1]]

    def inner(params: Any, rows: jax.Array) -> tuple[jax.Array, Any]:
        z, aux = between(params, rows, token_mask)
        return z.astype(x.dtype), aux

    (z, aux), pull_back = jax.vjp(inner, params, rows)
    d_in, d_out = kernel.shape
    w, u = kernel.astype(x.dtype), up.astype(x.dtype)
    if d_out >= d_in:
        y = jnp.concatenate([x, z], axis=-1) @ jnp.concatenate([w, u])
    else:
        y = x @ w + z @ u
    return (y, aux), (pull_back, x, kernel, down, up, z)


def _backward(between: Between, rows_dtype: Any, residuals: tuple, cotangents: tuple) -> tuple:
    del between, rows_dtype
    pull_back, x, kernel, down, up, z = residuals
    g, d_aux = cotangents
    d_in, d_out = kernel.shape
    w, p, u = kernel.astype(x.dtype), _aligned(down.astype(x.dtype)), up.astype(x.dtype)
    if d_out > 2 * d_in:
        through_base, dz = jnp.split(g @ jnp.concatenate([w, u]).T, [d_in], axis=-1)
    else:
        through_base, dz = None, g @ u.T
    d_params, d_rows = pull_back((dz, d_aux))
    q = _aligned(d_rows.astype(x.dtype))
    if d_out <= d_in:
        dx = jnp.concatenate([g, q], axis=-1) @ jnp.concatenate([w, p], axis=1).T
    else:
        dx = (g @ w.T if through_base is None else through_base) + q @ p.T
    d_down = _outer(x, q, down.dtype)[:, : down.shape[1]]
    return d_params, dx, None, d_down, _outer(z, g, up.dtype), None


def _aligned(matrix: jax.Array) -> jax.Array:
    """Zeros up to a multiple of 8 columns: 132 made LoRA-MoE's backward pass twice as long."""
    return jnp.pad(matrix, [(0, 0)] * (matrix.ndim - 1) + [(0, -matrix.shape[-1] % 8)])


def _outer(left: jax.Array, right: jax.Array, dtype: Any) -> jax.Array:
    """Sum over all tokens of the outer products of left [..., M] and right [..., N], [M, N]."""
    return jnp.einsum("...m,...n->mn", left, right, preferred_element_type=dtype)


low_rank_matmul.defvjp(_forward, _backward)
