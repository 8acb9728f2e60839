"""x W + f(x P) U with frozen W, for one or more layers with the same input x.

P [I, Q] projects down, U [R, O] projects up, and f acts on the projected rows: z = f(x P). At
typical sizes, one pass over a wide array costs as much as the adapter itself. `low_rank_matmul`
therefore merges matmuls. Let g be the gradient of the output, and q that of x P:

- W gets no gradient.
- One matmul computes x P for all layers. In the backward pass, one computes the gradients of all P,
  and another the gradient of x through them.
- If O >= I, x W + z U is one matmul, [x, z] [W; U].
- If O > 2 I, g Wᵀ and g Uᵀ are one matmul, g [W; U]ᵀ.
- If the outputs of all layers together are at most as wide as x, the gradient of x is one matmul,
  [g, q] [W, P]ᵀ.

The last three copy W, which pays off only for I or more tokens. They are not used on a CPU, where
they save no time and triple the compile time, nor where x W is in float8 (`frozen_matmul`), whose
product is added to z U in place. W is stored in its own dtype and cast to the dtype of x in each
pass, so quantized weights are only briefly dequantized.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.frozen_matmul import matmul, matmul_transposed, uses_float8
from lorasp_jax.kernels.platform import platform
from lorasp_jax.kernels.quantized_weights import QuantizedKernel
from lorasp_jax.kernels.rematerialization import save_for_backward

Mask: TypeAlias = jax.Array | None
"""Bool [...tokens]: False excludes a token from losses and statistics; None excludes none."""


class Bottleneck:
    """f of layers with a shared input. Hashable; objects that compare equal compute the same f."""

    def bottleneck(self, params: Any, rows: jax.Array, token_mask: Mask) -> tuple[jax.Array, Any]:
        """Return z [..., R] and a pytree of auxiliary outputs, from projected rows [..., Q]."""
        raise NotImplementedError

    def bottlenecks(
        self, params: Sequence[Any], projected: jax.Array, widths: Sequence[int], token_mask: Mask
    ) -> list[tuple[jax.Array, Any]]:
        """Return z and the auxiliary outputs of each layer.

        Args:
            params: parameters of each layer.
            projected: projected rows of all layers, concatenated, possibly with trailing padding.
            widths: Q of each layer.
        """
        each = jnp.split(projected, _ends(widths), axis=-1)[:-1]
        calls = zip(params, each, strict=True)
        return [_traced_once(self)(p, rows, token_mask) for p, rows in calls]

    def pack(self, params: Any) -> Any:
        """Convert a layer's parameters to the form that `stacked_bottlenecks` expects."""
        return params

    def stacked_bottlenecks(
        self, params: Any, projected: jax.Array, columns: range, token_mask: Mask
    ) -> tuple[jax.Array, Any]:
        """`bottlenecks` of n layers whose parameters are stacked, here with `jax.vmap`.

        Args:
            params: from `pack`, stacked [n, ...].
            projected: [...tokens, C], contains the projected rows of all layers.
            columns: start column of each layer in `projected`. The step is Q.

        Returns:
            z of all layers, concatenated to [...tokens, n R], and auxiliary outputs [n, ...].
        """
        tokens, (n, width) = projected.shape[:-1], (len(columns), columns.step)
        rows = projected[..., columns.start : columns.stop].reshape(*tokens, n, width)

        def single_layer(params: Any, rows: jax.Array) -> tuple[jax.Array, Any]:
            return self.bottleneck(params, rows, token_mask)

        z, aux = jax.vmap(single_layer, in_axes=(0, -2), out_axes=(-2, 0))(params, rows)
        return z.reshape(*tokens, n * z.shape[-1]), aux


class LowRankLayer(NamedTuple):
    """Arrays of one layer."""

    params: Any
    """Parameters of f."""
    kernel: jax.Array | QuantizedKernel | Any
    """W [I, O] of any dtype, frozen."""
    down: jax.Array
    """P [I, Q], fp32, cast to the dtype of x on use."""
    up: jax.Array
    """U [R, O], fp32, cast to the dtype of x on use."""


# jit traces and lowers the function once for all layers of equal shapes.
@functools.partial(jax.jit, static_argnums=(0, 1))
@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def low_rank_matmul(
    f: Bottleneck,
    rows_dtype: Any,
    layers: Sequence[LowRankLayer],
    x: jax.Array,
    token_mask: Mask,
) -> list[tuple[jax.Array, Any]]:
    """Return (x W + z U, aux) of each layer, where z, aux = f(params, x P, token_mask).

    Args:
        f: computes z of all layers.
        rows_dtype: dtype of x P, which is accumulated in fp32.
        layers: the arrays of each layer.
        x: [..., I]; the outputs have its dtype.
        token_mask: passed to f.
    """
    projected = jnp.matmul(x, _concat_downs(layers, x.dtype), preferred_element_type=rows_dtype)
    params = [layer.params for layer in layers]
    return _outputs(layers, x, f.bottlenecks(params, projected, _widths(layers), token_mask))


@functools.cache
def _traced_once(f: Bottleneck) -> Callable[..., tuple[jax.Array, Any]]:
    """Return f, traced once for all layers for which it has equal shapes."""
    return jax.jit(f.bottleneck, inline=True)


def _outputs(
    layers: Sequence[LowRankLayer], x: jax.Array, z_aux: Sequence[tuple[jax.Array, Any]]
) -> list[tuple[jax.Array, Any]]:
    return [
        (base_plus_low_rank(x, z, layer.kernel, layer.up), aux)
        for layer, (z, aux) in zip(layers, z_aux, strict=True)
    ]


def _forward(
    f: Bottleneck,
    rows_dtype: Any,
    layers: Sequence[LowRankLayer],
    x: jax.Array,
    token_mask: Mask,
) -> tuple:
    def inner(params: list[Any], projected: jax.Array) -> list[tuple[jax.Array, Any]]:
        z_aux = f.bottlenecks(params, projected, _widths(layers), token_mask)
        return [(z.astype(x.dtype), aux) for z, aux in z_aux]

    projected = jnp.matmul(x, _concat_downs(layers, x.dtype), preferred_element_type=rows_dtype)
    z_aux, vjp = jax.vjp(inner, [layer.params for layer in layers], projected)
    return _outputs(layers, x, z_aux), (layers, x, vjp, [z for z, _ in z_aux])


def base_plus_low_rank(
    x: jax.Array, z: jax.Array, kernel: jax.Array | QuantizedKernel, up: jax.Array
) -> jax.Array:
    """Compute x W + z U, [..., O], in the dtype of x [..., I], from z [..., R]."""
    d_in, d_out = kernel.shape
    u, z = up.astype(x.dtype), z.astype(x.dtype)
    if d_out >= d_in and _should_concat(kernel, x, d_out):
        return jnp.concatenate([x, z], axis=-1) @ jnp.concatenate([kernel.astype(x.dtype), u])
    return save_for_backward(matmul(x, kernel) + z @ u, d_in)


def _backward(
    f: Bottleneck, rows_dtype: Any, residuals: tuple, cotangents: Sequence[tuple]
) -> tuple:
    del f, rows_dtype
    layers, x, vjp, z_of_layers = residuals
    gradients = [g for g, _ in cotangents]
    base_input_grads, dz_aux = [], []
    for layer, (g, d_aux) in zip(layers, cotangents, strict=True):
        d_in, d_out = layer.kernel.shape
        u, base_input_grad, dz = layer.up.astype(x.dtype), None, None
        if d_out > 2 * d_in and _should_concat(layer.kernel, g, d_in):
            w = layer.kernel.astype(x.dtype)
            base_input_grad, dz = jnp.split(g @ jnp.concatenate([w, u]).T, [d_in], axis=-1)
        base_input_grads.append(base_input_grad)
        dz_aux.append((g @ u.T if dz is None else dz, d_aux))
    d_params, d_projected = vjp(dz_aux)
    q = d_projected.astype(x.dtype)
    dx = _input_gradient(layers, x, gradients, base_input_grads, q)
    d_downs = jnp.split(_outer(x, q, layers[0].down.dtype), _ends(_widths(layers)), axis=-1)[:-1]
    d_layers = [
        LowRankLayer(d_param, None, d_down, _outer(z, g, layer.up.dtype))
        for layer, d_param, d_down, z, g in zip(
            layers, d_params, d_downs, z_of_layers, gradients, strict=True
        )
    ]
    return d_layers, dx, None


def _input_gradient(
    layers: Sequence[LowRankLayer],
    x: jax.Array,
    gradients: Sequence[jax.Array],
    base_input_grads: Sequence[jax.Array | None],
    q: jax.Array,
) -> jax.Array:
    """Compute Σ g Wᵀ + q Pᵀ, [..., I]; `base_input_grads` holds each g Wᵀ if already computed."""
    p, kernels = _concat_downs(layers, x.dtype), [layer.kernel for layer in layers]
    d_in = x.shape[-1]
    is_narrow = sum(g.shape[-1] for g in gradients) <= d_in
    pairs = list(zip(gradients, kernels, strict=True))
    if is_narrow and all(_should_concat(kernel, g, d_in) for g, kernel in pairs):
        w = [kernel.astype(x.dtype) for kernel in kernels]
        return jnp.concatenate([*gradients, q], axis=-1) @ jnp.concatenate([*w, p], axis=1).T
    dx = q @ p.T
    for (g, kernel), base_input_grad in zip(pairs, base_input_grads, strict=True):
        dx += matmul_transposed(g, kernel) if base_input_grad is None else base_input_grad
    return dx


def _should_concat(kernel: jax.Array | QuantizedKernel, x: jax.Array, width: int) -> bool:
    """Return whether concatenating W pays off for a product with x of `width` columns.

    See the module docstring.
    """
    rows = math.prod(x.shape[:-1])
    has_many_rows = rows >= kernel.shape[0]
    return has_many_rows and platform() != "cpu" and not uses_float8(kernel, rows, width)


def _concat_downs(layers: Sequence[LowRankLayer], dtype: Any) -> jax.Array:
    """Concatenate the P of all layers, [I, ΣQ], padded, in the dtype of x."""
    return pad_columns(jnp.concatenate([layer.down.astype(dtype) for layer in layers], axis=1))


def _widths(layers: Sequence[LowRankLayer]) -> list[int]:
    """Return Q of each layer."""
    return [layer.down.shape[1] for layer in layers]


def _ends(widths: Sequence[int]) -> list[int]:
    """Return the column after the last one of each layer; only padding follows the last layer's."""
    return list(itertools.accumulate(widths))


def pad_columns(matrix: jax.Array) -> jax.Array:
    """Zero-pad to a multiple of 8 columns; a width of 132 doubled LoRA-MoE's backward time."""
    return jnp.pad(matrix, [(0, 0)] * (matrix.ndim - 1) + [(0, -matrix.shape[-1] % 8)])


def _outer(left: jax.Array, right: jax.Array, dtype: Any) -> jax.Array:
    """Sum the outer products of left [..., M] and right [..., N] over all tokens, [M, N]."""
    return jnp.einsum("...m,...n->mn", left, right, preferred_element_type=dtype)


low_rank_matmul.__wrapped__.defvjp(_forward, _backward)
