"""An adapted dense layer on arrays, or several with a shared input."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax.typing import Dtype

from lorasp_jax.dense import validate
from lorasp_jax.kernels.frozen_matmul import frozen_matmul
from lorasp_jax.kernels.low_rank_matmul import Bottleneck, LowRankLayer, Mask, low_rank_matmul
from lorasp_jax.kernels.quantized_weights import QuantizedKernel
from lorasp_jax.peft import Aux, Method
from lorasp_jax.peft.fields import short
from lorasp_jax.peft.method import Params


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
    token_mask: Mask = None,
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
        ValueError: x is not floating point, the shapes do not match, or `params` and `method` do
            not go together.
    """
    layer = DenseLayer(kernel, bias, params, method, dropout_key)
    validate.layer(layer)
    x = cast_input(getattr(x, "dtype", None), x, kernel, token_mask, kernel.shape[0])
    return apply_layer(layer, x, token_mask)


def apply_layer(layer: DenseLayer, x: jax.Array, token_mask: Mask) -> tuple[jax.Array, Aux]:
    """Compute `dense` without checks."""
    matrix, method = _matrix(layer), layer.method
    if method is None or layer.params is None:
        result = _base(x, matrix), Aux()
    elif layer.dropout_key is not None:
        result = method.apply_with_dropout(
            layer.params, x, matrix, layer.dropout_key, token_mask=token_mask
        )
    else:
        result = method.apply(layer.params, x, matrix, token_mask=token_mask)
    return _with_bias(layer, x, result)


def dense_shared_input(
    x: jax.Array, layers: Sequence[DenseLayer], *, token_mask: Mask = None
) -> list[tuple[jax.Array, Aux]]:
    """`dense` for several layers with a shared input, without its checks.

    Layers with the same method and without dropout compute their down-projections in one matmul.

    Args:
        x: [...tokens, I], in the dtype to compute in.
        layers: arguments of `dense` for each layer.

    Returns:
        y and aux of each layer.
    """
    groups: dict[Bottleneck, list[tuple[int, Any, LowRankLayer]]] = {}
    results: dict[int, tuple[jax.Array, Aux]] = {}
    for i, layer in enumerate(layers):
        has_sum = layer.params is not None and layer.dropout_key is None
        method = layer.method if has_sum else None
        if method is None or not method.is_low_rank_sum:
            results[i] = apply_layer(layer, x, token_mask)
            continue
        arrays = method.low_rank_layer(layer.params, _matrix(layer))
        member = i, method.rows_dtype(x.dtype), arrays
        groups.setdefault(method.implementation(layer.params), []).append(member)
    for f, members in groups.items():
        indices, rows_dtypes, arrays = zip(*members, strict=True)
        outputs = low_rank_matmul(f, rows_dtypes[0], list(arrays), x, token_mask)
        for i, (y, aux) in zip(indices, outputs, strict=True):
            aux = dataclasses.replace(aux, token_mask=token_mask)
            results[i] = _with_bias(layers[i], x, (y, aux))
    return [results[i] for i in range(len(layers))]


def _matrix(layer: DenseLayer) -> jax.Array:
    """The kernel as a matrix [I, O]."""
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


def cast_input(
    dtype: Dtype | None, x: Any, kernel: Any, token_mask: Any = None, width: int | None = None
) -> jax.Array:
    """Check a layer's input and mask, and cast x to the compute dtype.

    Args:
        dtype: compute dtype; None promotes the dtypes of x and kernel.
        x: [...tokens, I].
        kernel: the layer's kernel.
        token_mask: bool [...tokens] or None.
        width: I; None to not check it.

    Raises:
        ValueError: x is not an array that can be cast to a floating-point dtype, or x or the mask
            has the wrong shape.
    """
    is_array = isinstance(x, jax.Array | np.ndarray) and x.ndim
    if not is_array or not (x.dtype == bool or jnp.issubdtype(x.dtype, jnp.number)):
        raise ValueError(f"x must be an array [...tokens, I], got {short(x)}")
    try:
        x = x.astype(dtype or jnp.promote_types(x.dtype, kernel.dtype))
    except jax.dtypes.TypePromotionError as error:
        raise ValueError(
            f"cannot promote {x.dtype} input and {kernel.dtype} kernel: pass a compute dtype, such "
            "as dtype=jnp.bfloat16"
        ) from error
    if not jnp.issubdtype(x.dtype, jnp.floating):
        raise ValueError(f"x must be a floating-point array [...tokens, I], got {short(x)}")
    if width is not None and x.shape[-1] != width:
        raise ValueError(
            f"input width {x.shape[-1]} does not match kernel shape {list(kernel.shape)}"
        )
    if token_mask is not None:
        actual = getattr(token_mask, "dtype", type(token_mask).__name__), np.shape(token_mask)
        if actual != (bool, x.shape[:-1]):
            raise ValueError(
                f"token_mask must be bool {list(x.shape[:-1])}, got {actual[0]} {list(actual[1])}"
            )
    return x
