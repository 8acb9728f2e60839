"""An adapted dense layer on arrays, or several with a shared input."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax.typing import Dtype

from lorasp_jax.dense import validate
from lorasp_jax.kernels.frozen_matmul import frozen_matmul
from lorasp_jax.kernels.quantized_weights import QuantizedKernel
from lorasp_jax.peft import Aux, Method, _validate
from lorasp_jax.peft._method import Params
from lorasp_jax.peft._shared_input import AdaptedKernel, apply_shared_input


class DenseLayer(NamedTuple):
    """Arguments of `dense` other than the input and its mask."""

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
    """x @ kernel + bias, with an optional adapter.

    Args:
      x: [...tokens, I].
      kernel: [I, *O]. Several output axes are flattened into one for the adapter.
      bias: broadcastable to [*O], or None.
      params: the adapter's parameters for the kernel as a matrix [I, O], or None.
      method: the adapter's method, given together with `params`. A method that trains the base
        weights takes no `params`.
      dropout_key: key for the adapter's dropout; None disables dropout.
      token_mask: bool [...tokens]; False marks padding, excluded from losses and statistics.

    Returns:
      y [...tokens, *O] in the dtype of x, and the adapter's aux.

    Raises:
      ValueError: x is not floating point, the shapes do not match, or `params` and `method` do not
        go together.
    """
    layer = DenseLayer(kernel, bias, params, method, dropout_key)
    matrix = _checked_matrix(layer, x, token_mask)
    if method is None or params is None:
        result = _base(x, matrix), Aux()
    elif dropout_key is not None:
        result = method.apply_with_dropout(params, x, matrix, dropout_key, token_mask=token_mask)
    else:
        result = method.apply(params, x, matrix, token_mask=token_mask)
    return _with_bias(layer, x, result)


def dense_shared_input(
    x: jax.Array, layers: Sequence[DenseLayer], *, token_mask: jax.Array | None = None
) -> list[tuple[jax.Array, Aux]]:
    """`dense` for several layers with a shared input. Adapters without dropout share one matmul.

    Args:
      x: [...tokens, I].
      layers: arguments of `dense` for each layer.
      token_mask: bool [...tokens].

    Returns:
      y and aux of each layer.

    Raises:
      ValueError: see `dense`.
    """
    layers = [DenseLayer(*layer) for layer in layers]
    results: dict[int, tuple[jax.Array, Aux]] = {}
    adapted: dict[int, AdaptedKernel] = {}
    for i, layer in enumerate(layers):
        if layer.method is None or layer.params is None or layer.dropout_key is not None:
            results[i] = dense(x, *layer, token_mask=token_mask)
        else:
            adapted[i] = layer.method, layer.params, _checked_matrix(layer, x, token_mask)
    adapted_results = apply_shared_input([*adapted.values()], x, token_mask=token_mask)
    for i, result in zip(adapted, adapted_results, strict=True):
        results[i] = _with_bias(layers[i], x, result)
    return [results[i] for i in range(len(layers))]


def _checked_matrix(layer: DenseLayer, x: jax.Array, token_mask: jax.Array | None) -> jax.Array:
    """Validate layer, input and mask; return the kernel as a matrix [I, O]."""
    _validate.tokens(x, token_mask)
    validate.layer(layer, x.shape[-1])
    return layer.kernel.reshape(layer.kernel.shape[0], math.prod(layer.kernel.shape[1:]))


def _base(x: jax.Array, matrix: jax.Array | QuantizedKernel) -> jax.Array:
    if isinstance(matrix, QuantizedKernel):
        return frozen_matmul(x, matrix)
    return x @ matrix.astype(x.dtype)


def _with_bias(
    layer: DenseLayer, x: jax.Array, result: tuple[jax.Array, Aux]
) -> tuple[jax.Array, Aux]:
    y, aux = result
    y = y.reshape(*x.shape[:-1], *layer.kernel.shape[1:])
    return (y if layer.bias is None else y + layer.bias.astype(y.dtype)), aux


def cast_input(dtype: Dtype | None, x: Any, kernel: Any) -> jax.Array:
    """Cast x to the compute dtype; None promotes the dtypes of x and kernel.

    Raises:
      ValueError: x is not an array, or the dtypes cannot be promoted, as with 8-bit floating-point
        kernels.
    """
    try:
        return validate.array(x).astype(dtype or jnp.promote_types(x.dtype, kernel.dtype))
    except jax.dtypes.TypePromotionError as error:
        raise ValueError(
            f"cannot promote {x.dtype} input and {kernel.dtype} kernel: pass a compute dtype, such "
            "as dtype=jnp.bfloat16"
        ) from error
