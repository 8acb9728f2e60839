"""What the backward pass keeps of the forward pass if it recomputes the rest."""

import math
from typing import Any

import jax
from jax.ad_checkpoint import checkpoint_name

_CUDNN_ATTENTION = "dot_product_attention_fwd_wrapper"
_SAVED, _SAVED_WIDE = "saved", "saved, wide"
WIDE = 2
"""A product is wide if it has more than this many times the columns of its input."""


def save_for_backward(x: jax.Array, columns: int | None = None) -> jax.Array:
    """Mark x to be saved for the backward pass: the result of a kernel, or of several matmuls.

    `columns` are those of the input that x is a product of, if it is one.
    """
    is_wide = columns is not None and x.shape[-1] > WIDE * columns
    return checkpoint_name(x, _SAVED_WIDE if is_wide else _SAVED)


def save_products(primitive: Any, *shapes: Any, **params: Any) -> Any:
    """Save matmuls without batch axes, cuDNN attention and values marked for saving."""
    if primitive.name == _CUDNN_ATTENTION or params.get("name") in (_SAVED, _SAVED_WIDE):
        return True
    return jax.checkpoint_policies.dots_with_no_batch_dims_saveable(primitive, *shapes, **params)


def save_narrow_products(primitive: Any, *shapes: Any, **params: Any) -> Any:
    """Save what `save_products` saves, except wide products."""
    if params.get("name") == _SAVED_WIDE:
        return False
    if primitive is jax.lax.dot_general_p:
        x, kernel = shapes
        (_, contracted), _ = params["dimension_numbers"]
        columns = math.prod(kernel.shape) // math.prod(kernel.shape[i] for i in contracted)
        if columns > WIDE * x.shape[-1]:
            return False
    return save_products(primitive, *shapes, **params)
