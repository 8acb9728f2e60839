"""Operations on blocks of arrays inside Pallas kernels for Triton, for attention."""

import math
from typing import Any

import jax
import jax.numpy as jnp

MASKED = -1e38
"""Logit of a masked key. Finite, so that a fully masked row gets a uniform softmax, not NaN."""
LOG2_E = math.log2(math.e)


def load(ref: Any, at: tuple[Any, ...], exist: jax.Array | None) -> jax.Array:
    """Load the elements at an index; those that do not exist are 0. None: all exist."""
    from jax.experimental.pallas import triton  # absent from builds without NVIDIA support

    return triton.load(ref.at[at], mask=exist, other=None if exist is None else 0)


def store(ref: Any, at: tuple[Any, ...], values: jax.Array, exist: jax.Array | None) -> None:
    """Store values that exist, in the dtype of the array. None: all exist."""
    from jax.experimental.pallas import triton

    triton.store(ref.at[at], values.astype(ref.dtype), mask=exist)


def matmul(a: jax.Array, b: jax.Array, contracted: tuple[int, int]) -> jax.Array:
    """Multiply matrices over one axis of each, in fp32."""
    axes = (contracted[:1], contracted[1:]), ((), ())
    return jax.lax.dot_general(a, b, axes, preferred_element_type=jnp.float32)
