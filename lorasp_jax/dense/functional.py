"""One adapted dense layer on arrays, or several that read one input."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax.typing import Dtype

from lorasp_jax.dense import validate
from lorasp_jax.peft import Aux, Method, _arguments
from lorasp_jax.peft._method import Params
from lorasp_jax.peft._shared_input import AdaptedKernel, apply_shared_input


class DenseLayer(NamedTuple):
    """What `dense` takes beside the input."""

    kernel: jax.Array
    bias: jax.Array | None = None
    params: Params | None = None
    method: Method | None = None
    dropout_key: jax.Array | None = None


def dense(
    x: jax.Array,
    kernel: jax.Array,
    bias: jax.Array | None = None,
    params: Params | None = None,
    method: Method | None = None,
    dropout_key: jax.Array | None = None,
    *,
    token_mask: jax.Array | None = None,
) -> tuple[jax.Array, Aux]:
    """x @ kernel + bias through an adapter, or plainly without one.

    Args:
      x: [...tokens, I].
      kernel: [I, *O]. More than one output axis is one linear map onto all of them.
      bias: broadcastable to [*O], or None.
      params: the adapter's parameters for the kernel as a matrix [I, O], or None.
      method: the adapter's method, given with `params`.
      dropout_key: for the method's dropout in a training step; None: nothing is dropped.
      token_mask: bool [...tokens]; False (padding) stays out of losses and statistics.

    Returns:
      y [...tokens, *O] in the type of x, and the adapter's aux.

    Raises:
      ValueError: x is of integers or does not end in the kernel's input size, or a mask of another
        shape.
    """
    layer = DenseLayer(kernel, bias, params, method, dropout_key)
    matrix = _checked_matrix(layer, x, token_mask)
    if method is None or params is None:
        found = x @ matrix.astype(x.dtype), Aux()
    elif dropout_key is not None:
        found = method.apply_with_dropout(params, x, matrix, dropout_key, token_mask=token_mask)
    else:
        found = method.apply(params, x, matrix, token_mask=token_mask)
    return _with_bias(layer, x, found)


def dense_shared_input(
    x: jax.Array, layers: Sequence[DenseLayer], *, token_mask: jax.Array | None = None
) -> list[tuple[jax.Array, Aux]]:
    """`dense` of several layers that share their input, which their adapters then read once.

    Args:
      x: [...tokens, I].
      layers: (kernel, bias, params, method, dropout_key) of each; see `dense`.
      token_mask: bool [...tokens].

    Returns:
      y and aux of each layer.

    Raises:
      ValueError: as `dense`.
    """
    layers = [DenseLayer(*layer) for layer in layers]
    found: dict[int, tuple[jax.Array, Aux]] = {}
    sharing: dict[int, AdaptedKernel] = {}
    for i, layer in enumerate(layers):
        if layer.method is None or layer.params is None or layer.dropout_key is not None:
            found[i] = dense(x, *layer, token_mask=token_mask)
        else:
            sharing[i] = layer.method, layer.params, _checked_matrix(layer, x, token_mask)
    together = apply_shared_input([*sharing.values()], x, token_mask=token_mask)
    for i, one in zip(sharing, together, strict=True):
        found[i] = _with_bias(layers[i], x, one)
    return [found[i] for i in range(len(layers))]


def _checked_matrix(layer: DenseLayer, x: jax.Array, token_mask: jax.Array | None) -> jax.Array:
    """The layer's kernel as a matrix [I, O], once it fits the input."""
    _arguments.tokens(x, token_mask)
    validate.layer(layer, x.shape[-1])
    return layer.kernel.reshape(layer.kernel.shape[0], math.prod(layer.kernel.shape[1:]))


def _with_bias(
    layer: DenseLayer, x: jax.Array, found: tuple[jax.Array, Aux]
) -> tuple[jax.Array, Aux]:
    y, aux = found
    y = y.reshape(*x.shape[:-1], *layer.kernel.shape[1:])
    return (y if layer.bias is None else y + layer.bias.astype(y.dtype)), aux


def cast_input(dtype: Dtype | None, x: Any, kernel: Any) -> jax.Array:
    """x in the type of a layer's computation; None: the type that x and the kernel promote to.

    Raises:
      ValueError: x is no array, or no such type is there, as for kernels of 8 bits.
    """
    try:
        return validate.array(x).astype(dtype or jnp.promote_types(x.dtype, kernel.dtype))
    except jax.dtypes.TypePromotionError as error:
        raise ValueError(
            f"a layer with a kernel of {kernel.dtype} needs a dtype to compute {x.dtype} in, such "
            "as dtype=jnp.bfloat16."
        ) from error
