"""Quantize a frozen base, before or after adapting it (QLoRA, arXiv 2305.14314).

    model, errors = quantize(model, [("vision", None), (".*", "nf4")])

Kernels of dense layers and einsums (flattened to matrices) are quantized to 8 or 4.5 bits per
weight. Adapters, biases, norms, embeddings and convolutions are unchanged. Gradients still flow to
x and the adapters, and adapters can still be attached, saved and combined. `merge` dequantizes the
kernel of each adapted layer before adding the delta. With "float8", NVIDIA GPUs since Ada and
Hopper also multiply large matrices in float8; all other kinds only save memory.

Adapters that split a kernel (PiSSA, OLoRA) must be attached before quantization, which then
quantizes the residual.
"""

import math
import re
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.dense import AdaptedLayer, AdapterParam, Dense, validate
from lorasp_jax.kernels.frozen_matmul import uses_float8
from lorasp_jax.kernels.platform import multiplies_float8
from lorasp_jax.kernels.quantized_weights import KINDS, Kind, QuantizedKernel, quantize_kernel

# (id of a variable, equation, kind) -> (quantized variable, original variable, error). Storing the
# original keeps its id valid.
Shared: TypeAlias = dict[tuple[int, str, Kind], tuple[nnx.Param[Any], nnx.Param[Any], float]]


class QuantizationResult(NamedTuple):
    """A model with quantized kernels, and the quantization errors.

    Attributes:
        model: with quantized kernels.
        errors: relative error ‖W − Ŵ‖ / ‖W‖ of the quantized kernel Ŵ by path, in the Frobenius
            norm over all layers of a stack. For isotropic inputs, this is also the relative RMS
            error of the layer's output, without bias. NaN while JAX traces, as inside
            `nnx.eval_shape`.
    """

    model: nnx.Module
    errors: dict[str, float]


def quantize(model: nnx.Module, rules: Sequence[tuple[str, Kind | None]]) -> QuantizationResult:
    """Quantize the kernels of dense layers and einsums by path rules.

    Args:
        model: not modified; the result shares all other arrays. Kernels in host memory, which are
            quantized on the device one at a time, stay there.
        rules: (pattern, kind) pairs, where kind is "float8", "int8", "nf4" or None. As for `adapt`,
            the first match wins, and None skips the path. Rules apply to `Dense`, `nnx.Linear`,
            `nnx.LinearGeneral`, `nnx.Einsum` and adapted layers of other einsum classes.

    Raises:
        ValueError: a rule applies to no layer (the message lists near misses), a kind is unknown,
            or a kernel is trainable, already quantized or not finite.
    """
    kinds = " or ".join(map(repr, (*KINDS, None)))
    paths.check_rules(rules, lambda kind: kind in (*KINDS, None), kinds)
    validate.with_values(model)
    root, errors, used = nnx.List([nnx.merge(*adaptation.split(model))]), {}, set()
    shared: Shared = {}
    layers = paths.locate_matmul_layers(root)
    for location in layers:
        matching = [rule for rule in rules if re.search(rule[0], location.path)]
        if not matching:
            continue
        used.add(matching[0])
        if (kind := matching[0][1]) is not None:
            with paths.naming("quantize", location.path):
                layer, errors[location.path] = _quantize_layer(location.child, kind, shared)
            paths.set_child(location, layer)
    for rule in rules:
        if rule not in used:
            available = [location.path for location in layers]
            raise ValueError(paths.no_match_message(rule[0], available, {}))
    return QuantizationResult(root[0], errors)


def is_quantized(model: nnx.Module) -> bool:
    """Whether the model has a quantized kernel."""
    parameters = paths.locate(nnx.List([model]), nnx.Param)
    return any(isinstance(location.child.get_value(), QuantizedKernel) for location in parameters)


def only_saves_memory(module: nnx.Module) -> bool:
    """Whether a kernel of a `Dense` is quantized, but is not to be multiplied in float8."""
    kinds = {kernel.kind for _, kernel in _quantized_layers(module)}
    return bool(kinds - {"float8"} if multiplies_float8() else kinds)


def dequantize(module: nnx.Module, *, keep_float8: bool = False) -> None:
    """Dequantize the kernel of each unstacked `Dense`, in place and in its compute dtype.

    With `keep_float8`, kernels stay as they are if every product with them is in float8.
    """
    for layer, kernel in _quantized_layers(module):
        if not (keep_float8 and uses_float8(kernel, rows=1, width=kernel.shape[-1])):
            layer.set_kernel_matrices(kernel.astype(layer.dtype or kernel.dtype))


def _quantized_layers(module: nnx.Module) -> Iterator[tuple[Dense, QuantizedKernel]]:
    """Yield each `Dense` with a quantized kernel, and the kernel."""
    layers = [layer for _, layer in nnx.iter_modules(module) if isinstance(layer, Dense)]
    for layer in layers:
        kernel: Any = layer.kernel_matrices()
        if isinstance(kernel, QuantizedKernel):
            yield layer, kernel


def _quantize_layer(layer: nnx.Module, kind: Kind, shared: Shared) -> tuple[AdaptedLayer, float]:
    """Quantize the layer's kernel, preserving sharing; return the layer and the relative error."""
    layer = nnx_layers.make_adaptable(layer, {})
    variable, kernel = layer.kernel_variable(), layer.kernel_matrices()
    if isinstance(variable, AdapterParam):
        raise ValueError("its kernel is trainable; only frozen kernels can be quantized")
    if isinstance(kernel, QuantizedKernel):
        raise ValueError("its kernel is already quantized")
    key = id(variable), getattr(layer, "kernel_equation", ""), kind
    if key not in shared:
        on_host = isinstance(kernel, np.ndarray)
        kernel = jnp.asarray(kernel)  # a kernel on the host is copied to the device only once
        quantized_kernel = quantize_kernel(kernel, kind)
        error = _error(kernel, quantized_kernel)
        if on_host:
            quantized_kernel = jax.device_get(quantized_kernel)
        layer.set_kernel_matrices(quantized_kernel)
        error = math.nan if isinstance(error, jax.core.Tracer) else float(error)
        shared[key] = layer.kernel_variable(), variable, error
    new, _, error = shared[key]
    layer.set_kernel_variable(new)
    return layer, error


@jax.jit
def _error(kernel: jax.Array, quantized_kernel: QuantizedKernel) -> jax.Array:
    """Relative error ‖W − Ŵ‖ / ‖W‖, 0 for a kernel of zeros."""

    def squares(kernels: tuple[jax.Array, QuantizedKernel]) -> jax.Array:
        original, rounded = (each.astype(jnp.float32) for each in kernels)
        return jnp.stack([jnp.sum(jnp.square(x)) for x in (original, original - rounded)])

    pair = kernel, quantized_kernel
    # One layer after another, as when quantizing.
    total = squares(pair) if kernel.ndim == 2 else jax.lax.map(squares, pair).sum(0)
    norm, difference = jnp.sqrt(total)
    return jnp.where(norm > 0, difference / norm, 0.0)
