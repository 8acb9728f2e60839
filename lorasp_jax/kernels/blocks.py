"""Launch parameters of Pallas kernels for Triton, and what attention kernels do with blocks."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

MASKED = -1e38
"""Logit of a masked key. Finite, so that a fully masked row gets a uniform softmax, not NaN."""
LOG2_E = math.log2(math.e)


class Launch(NamedTuple):
    """Launch parameters of a kernel."""

    rows: int
    """Rows per block, a power of two: 1, or at least 16, the minimum dimension of a matmul in
    Triton. In attention, a row is one query of one head."""
    warps: int
    """Warps per program."""
    programs: int = 1
    """Maximum number of programs that share the blocks: those of rows in a row-wise kernel, those
    of keys in cached attention."""
    keys: int = 0
    """Keys per matmul in attention, a power of two, at least 16."""


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
