"""x W and g Wᵀ with a frozen W, in float8 where W is stored so and the GPU multiplies it faster.

A float8 W has one scale t, W = t W8, and e4m3 codes W8. The other factor is quantized on the fly
with the scale s = max |x| / M, where M is the largest number of its format:

    x W  = s t (x / s)8 W8      x in e4m3, which has the finer steps
    g Wᵀ = s t (g / s)8 W8ᵀ     g in e5m2, which has the wider range

Products are summed in fp32. With normal operands, the relative error is 3.7 % for x W and 5.7 % for
g Wᵀ (Frobenius norm). XLA hands the scales to cuBLASLt, which adds a third term in place, but only
in this form: if the codes are converted to the dtype of x before the product, XLA first dequantizes
whole stacks of layers. Both factors must have the summed axis last, so W8 is stored as [O, I], and
only g Wᵀ transposes it.

Quantizing takes two passes over x, which cost as much as the faster product saves unless W is wide
and there are many tokens, or W is so large that dequantizing it takes longer even for few tokens.
Elsewhere, and on other devices, W is dequantized to the dtype of x.
"""

import math
from collections.abc import Sequence
from typing import Any, TypeGuard

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.platform import multiplies_float8
from lorasp_jax.kernels.quantized_weights import QuantizedKernel
from lorasp_jax.kernels.rematerialization import save_for_backward
from lorasp_jax.kernels.row_sharding import by_rows

Kernel = jax.Array | QuantizedKernel

MIN_WIDTH, MIN_PRODUCTS, MIN_SIZE = 1024, 2**34, 2**25
"""Least columns of the result, and either least multiplications T I O or least weights I O, for a
product in float8."""


def frozen_matmul(x: jax.Array, kernel: Kernel) -> jax.Array:
    """Compute x W, [..., O], in the dtype of x [..., I]. W [I, O] receives no gradient."""
    return _frozen_matmul(x, kernel)  # whose decorator hides its types


@jax.custom_vjp
def _frozen_matmul(x: jax.Array, kernel: Kernel) -> jax.Array:
    return matmul(x, kernel)


def matmul(x: jax.Array, kernel: Kernel) -> jax.Array:
    """Compute x W, [..., O], in the dtype of x [..., I], without a derivative in float8."""
    if uses_float8(kernel, math.prod(x.shape[:-1]), kernel.shape[-1]):
        return _float8_product(x, jnp.float8_e4m3fn, kernel, axis=1)
    return x @ kernel.astype(x.dtype)


def matmul_transposed(g: jax.Array, kernel: Kernel) -> jax.Array:
    """Compute g Wᵀ, [..., I], in the dtype of g [..., O], without a derivative in float8."""
    if uses_float8(kernel, math.prod(g.shape[:-1]), kernel.shape[-2]):
        return _float8_product(g, jnp.float8_e5m2, kernel, axis=0)
    return g @ kernel.astype(g.dtype).T


def uses_float8(kernel: Kernel, rows: int, width: int) -> TypeGuard[QuantizedKernel]:
    """Return whether a product of `rows` rows and `kernel` with `width` columns is in float8."""
    is_float8 = isinstance(kernel, QuantizedKernel) and kernel.kind == "float8"
    size = math.prod(kernel.shape)
    is_large = size >= MIN_SIZE or rows * size >= MIN_PRODUCTS
    return is_float8 and width >= MIN_WIDTH and is_large and multiplies_float8()


def encode(x: jax.Array, dtype: Any) -> tuple[jax.Array, jax.Array]:
    """Return codes of a float8 dtype, and their scale, f32 []; NaN or infinity in x gives NaN."""
    largest = jnp.max(jnp.abs(x)).astype(jnp.float32)
    # Division by a subnormal scale, which XLA may take for 0, could give NaN.
    scale = jnp.maximum(largest / float(jnp.finfo(dtype).max), jnp.finfo(jnp.float32).tiny)
    return (x.astype(jnp.float32) / scale).astype(dtype), scale


def _float8_product(x: jax.Array, dtype: Any, kernel: QuantizedKernel, axis: int) -> jax.Array:
    """Encode x and sum its products with W8 [O, I] over this axis of W8, in the dtype of x.

    Each device scales its own rows: one scale for all would be a collective before each product.
    """

    def product(shared: Sequence[jax.Array], arrays: Sequence[jax.Array]) -> tuple:
        (w, w_scale), (rows,) = shared, arrays
        codes, scale = encode(rows, dtype)
        # Without the barrier XLA merges products of equal codes, as by gate and up, and copies W8.
        codes, w = jax.lax.optimization_barrier((codes, w))
        axes = ((1,), (axis,)), ((), ())
        sums = jax.lax.dot_general(codes, w, axes, preferred_element_type=x.dtype)
        return [sums * (scale * w_scale.reshape(())).astype(x.dtype)], []

    rows = x.reshape(-1, x.shape[-1])
    (y,), _ = by_rows(product, [kernel.codes[0], kernel.scale], [rows])
    return save_for_backward(y.reshape(*x.shape[:-1], -1), x.shape[-1])


def _forward(x: jax.Array, kernel: Kernel) -> tuple[jax.Array, Kernel]:
    return matmul(x, kernel), kernel


def _backward(kernel: Kernel, g: jax.Array) -> tuple[jax.Array, None]:
    return matmul_transposed(g, kernel), None


_frozen_matmul.defvjp(_forward, _backward)
