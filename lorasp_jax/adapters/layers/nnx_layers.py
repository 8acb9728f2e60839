"""Adapted einsums, embeddings and convolutions in third-party NNX models.

An adapted layer subclasses the original class and keeps its attributes, so model code that accesses
the layer still works. `without_adapter` restores the original class. `nnx.Linear` becomes a `Dense`
instead.
"""

import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen, nnx

from lorasp_jax.adapters import _compat
from lorasp_jax.adapters.layers import einsum
from lorasp_jax.dense import AdaptedLayer, Dense, cast_input, reject_out_sharding, with_value
from lorasp_jax.kernels.quantized_weights import QuantizedKernel
from lorasp_jax.peft import LoRA, Method
from lorasp_jax.peft.fields import short
from lorasp_jax.peft.method import dropout, dropout_rate

Einsums = Mapping[type, Callable[[Any], tuple[str, str | None]]]
"""Functions layer -> (kernel name, equation), by NNX or Linen layer class. The equation is None for
a Linen layer that takes it as a str argument of its call."""

EINSUMS: Einsums = {
    nnx.LinearGeneral: lambda layer: (
        "kernel",
        einsum.general_equation(layer.axis, tuple(layer.batch_axis), len(layer.out_features)),
    ),
    nnx.Einsum: lambda layer: ("kernel", layer.einsum_str),
}
# Adapted layers support these settings only at the listed values.
_DEFAULT_SETTINGS: dict[str, tuple[Any, ...]] = {
    "dot_general": (None, jax.lax.dot_general),
    "dot_general_cls": (None,),
    "einsum_op": (jnp.einsum,),
    "precision": (None,),
    "preferred_element_type": (None,),
    "promote_dtype": (_compat.nnx_promote_dtype, linen.dtypes.promote_dtype),
}


class EinsumLayer(AdaptedLayer):
    """Mixin for a layer that computes an einsum of its input and its kernel.

    Attributes:
        kernel_equation: see `lorasp_jax.adapters.layers.einsum`.
    """

    kernel_equation: str

    def __call__(self, x: jax.Array, *, out_sharding: None = None) -> jax.Array:
        """Compute y, see `einsum.einsum`.

        Raises:
            ValueError: out_sharding is not None.
        """
        if out_sharding is not None:
            reject_out_sharding()
        kernel = self.kernel_variable().get_value()
        bias = None if getattr(self, "bias", None) is None else self.bias.get_value()
        params = None if self.adapter is None else self.adapter.get_value()
        y, aux = einsum.einsum(
            self.kernel_equation,
            cast_input(getattr(self, "dtype", None), x, kernel),
            kernel,
            bias,
            params,
            self.method,
            self.dropout_key,
        )
        if self.adapter is not None:
            self.store_aux(aux)
        return y

    def kernel_matrices(self) -> jax.Array:
        """The kernel as [..., *batch, I, O]."""
        return einsum.to_matrices(self.kernel_equation, super().kernel_matrices())

    def stack_shape(self) -> tuple[int, ...]:
        """Sizes of the stack axes: the leading kernel axes that are not in the equation."""
        shape = super().kernel_matrices().shape
        return tuple(shape[: len(shape) - len(einsum.parse(self.kernel_equation).kernel)])

    def set_kernel_matrices(self, matrices: jax.Array | QuantizedKernel) -> None:
        """Replace the kernel by one given as [..., *batch, I, O]."""
        old = self.kernel_variable()
        kernel = einsum.from_matrices(self.kernel_equation, matrices, old.get_value().shape)
        self.set_kernel_variable(with_value(old, kernel))

    def without_adapter(self) -> nnx.Module:
        """Restore the original class, unless the kernel is quantized."""
        if isinstance(super().kernel_matrices(), QuantizedKernel):
            return super().without_adapter()
        layer = _restore_class(self)
        del layer.kernel_equation
        return layer


class LoRALayer(AdaptedLayer):
    """Mixin for a layer that adds the delta of one or more LoRAs to its original output."""

    def adapter_init(self, method: Method) -> Callable[[jax.Array, jax.Array], Any]:
        """See `lora_init`."""
        return lora_init(self, method)

    def with_delta(self, y: jax.Array, project: Callable[[jax.Array], jax.Array]) -> jax.Array:
        """Add the delta to y; `project` applies A to the layer's input."""
        method, params = self.method_and_params()
        z, aux = method.bottleneck(params, project(method.down(params)).astype(y.dtype), None)
        self.store_aux(aux)
        return y + z @ method.up(params).astype(y.dtype)

    def without_adapter(self) -> nnx.Module:
        """Restore the original class."""
        return _restore_class(self)


class EmbedLayer(LoRALayer):
    """Mixin for `nnx.Embed`: both lookups and the logits of `attend` use W + scale A B."""

    def __call__(self, inputs: jax.Array, *args: Any, **kwargs: Any) -> jax.Array:
        """Look up the rows [..., D] of ids [...]."""
        y = super().__call__(inputs, *args, **kwargs)
        return self.with_delta(y, lambda a: lookup(a, inputs))

    def attend(self, query: jax.Array, *args: Any, **kwargs: Any) -> jax.Array:
        """Inner products of queries [..., D] with the rows, [..., V]."""
        y = super().attend(query, *args, **kwargs)
        return y + attend_delta(*self.method_and_params(), query.astype(y.dtype))


class ConvLayer(LoRALayer):
    """Mixin for `nnx.Conv`: A is a convolution to R channels, B a pointwise convolution."""

    def __call__(self, inputs: jax.Array, *args: Any, **kwargs: Any) -> jax.Array:
        """Compute the convolution [..., *spatial, O]."""
        y = super().__call__(inputs, *args, **kwargs)
        if self.dropout_key is not None:
            inputs = dropout(inputs, dropout_rate(self.method), self.dropout_key)
        return self.with_delta(y, lambda a: convolve(self, a, inputs))

    def kernel_matrices(self) -> jax.Array:
        """The kernel [..., *sizes, I, O] as [..., sizes · I, O]."""
        kernel = super().kernel_matrices()
        outer = kernel.ndim - len(self.kernel_size) - 2
        return kernel.reshape(*kernel.shape[:outer], -1, kernel.shape[-1])


def lookup(table: jax.Array, ids: jax.Array) -> jax.Array:
    """Look up rows of a table as `nnx.Embed` does: a table of one row ignores the ids."""
    if table.shape[0] == 1:
        return jnp.broadcast_to(table, (*ids.shape, table.shape[1]))
    return jnp.take(table, ids, axis=0)


def attend_delta(method: Method, params: Any, query: jax.Array) -> jax.Array:
    """Inner products of queries [..., D] with the rows of LoRA's delta, scale · A B."""
    down, up = (matrix.astype(query.dtype) for matrix in (method.down(params), method.up(params)))
    return method.bottleneck(params, query @ up.T, None)[0].astype(query.dtype) @ down.T


def convolve(layer: Any, a: jax.Array, inputs: jax.Array) -> jax.Array:
    """Convolve inputs with A, using the layer's strides, padding and other settings.

    Args:
        layer: an NNX or Linen convolution; both have the same attribute names.
        a: LoRA's A, [sizes · I, R].
        inputs: [..., *spatial, I].
    """
    sizes = (layer.kernel_size,) if isinstance(layer.kernel_size, int) else layer.kernel_size
    same = ("strides", "padding", "input_dilation", "kernel_dilation", "dtype", "precision")
    kernel = a.reshape(*sizes, inputs.shape[-1], -1)
    return nnx.Conv(
        inputs.shape[-1],
        a.shape[-1],
        sizes,
        use_bias=False,
        kernel_init=lambda *_: kernel,
        rngs=nnx.Rngs(0),
        **{name: getattr(layer, name) for name in same},
    )(inputs)


def lora_init(layer: Any, method: Method) -> Callable[[jax.Array, jax.Array], Any]:
    """Function (key, kernel) that initializes LoRA for an embedding or a convolution.

    Raises:
        ValueError: the method is not plain LoRA, its initialization needs the kernel or statistics,
            or the convolution is grouped or masked.
    """
    if type(method) is not LoRA or method.splits_kernel or method.needs_statistics:
        raise ValueError(
            f"{type(layer).__name__} only supports LoRA whose initialization needs neither kernel "
            f"nor data, got {method}: add a leading rule with such a LoRA or None for this layer"
        )
    if not isinstance(layer, nnx.Conv | linen.Conv):
        return method.init_table
    if layer.feature_group_count != 1 or layer.mask is not None:
        raise ValueError("grouped and masked convolutions cannot be adapted")
    return method.init


def make_adaptable(layer: nnx.Module, einsums: Einsums) -> AdaptedLayer:
    """Convert a layer of a supported class to one that can carry an adapter.

    The layer is not modified; an `AdaptedLayer` is returned as is.

    Raises:
        ValueError: the layer has a custom matmul or precision, its equation cannot be adapted, or
            an attribute that adapted layers need already exists.
    """
    if isinstance(layer, AdaptedLayer):
        return layer
    known = supported_class(layer, einsums)
    if isinstance(layer, nnx.Linear) and known is nnx.Linear:
        return to_dense(layer)
    if known is nnx.Embed:
        return _with_mixin(layer, EmbedLayer, "embedding")
    if known is nnx.Conv:
        return _with_mixin(layer, ConvLayer, "kernel")
    check_settings(layer)
    name, equation = kernel_and_equation(layer, known, einsums)
    return _with_mixin(layer, EinsumLayer, name, equation)


def make_adaptable_like(layer: Any, other: AdaptedLayer) -> AdaptedLayer:
    """Convert a layer to one that can carry the adapter of another layer.

    The layer is not modified; it is returned as is if it can already carry the adapter.

    Raises:
        ValueError: the layer is not of the other layer's original class.
    """
    if isinstance(layer, type(other)):
        return layer
    mixin, original = (Dense, nnx.Linear) if isinstance(other, Dense) else type(other).__bases__
    if not isinstance(layer, original):
        raise ValueError(
            f"the layer must be of class {original.__name__}, got {type(layer).__name__}"
        )
    if mixin is Dense:
        return to_dense(layer)
    return _with_mixin(layer, mixin, other.kernel_name, getattr(other, "kernel_equation", None))


def supported_class(layer: Any, einsums: Einsums) -> type[nnx.Module] | None:
    """Supported class whose `__call__` the layer uses; None if it overrides `__call__`."""
    classes = (nnx.Linear, nnx.Embed, nnx.Conv, *EINSUMS, *einsums)
    matches = (cls for cls in classes if isinstance(layer, cls))
    return next((cls for cls in matches if type(layer).__call__ is cls.__call__), None)


def kernel_and_equation(layer: Any, known: type | None, einsums: Einsums) -> tuple[str, str]:
    """Kernel name and equation of an einsum layer.

    Raises:
        ValueError: the equation cannot be adapted, or the layer has no such kernel.
    """
    assert known is not None
    name, equation = describe_einsum({**EINSUMS, **einsums}[known], layer)
    if equation is None:
        raise ValueError(
            f"the einsums function of {type(layer).__name__} must return an equation, got None"
        )
    if not isinstance(getattr(layer, name, None), nnx.Param):
        raise ValueError(f"this {type(layer).__name__} has no parameter {name!r}")
    einsum.parse(equation)
    return name, equation


def check_einsums(einsums: Any) -> None:
    """Raise ValueError unless `einsums` maps layer classes to functions."""
    pairs = einsums.items() if isinstance(einsums, Mapping) else [(None, None)]
    if not all(isinstance(cls, type) and callable(describe) for cls, describe in pairs):
        raise ValueError(
            "einsums must map layer classes to functions layer -> (kernel name, equation), got "
            f"{short(einsums)}"
        )


def describe_einsum(describe: Callable[[Any], Any], layer: Any) -> tuple[str, str | None]:
    """Call an `Einsums` function; raise ValueError if it returns a wrong type."""
    result = describe(layer)
    is_pair = isinstance(result, tuple) and len(result) == 2
    if not is_pair or not isinstance(result[0], str) or not isinstance(result[1], str | None):
        raise ValueError(f"einsums functions must return (name, equation), got {short(result)}")
    return result


def matrices_shape(layer: Any, einsums: Einsums) -> tuple[int, ...]:
    """Shape [..., *batch, I, O] of the kernel matrices of a supported layer, adapted or not.

    For a convolution, I is the product of its sizes and its number of input channels.

    Raises:
        ValueError: the equation cannot be adapted.
    """
    if isinstance(layer, AdaptedLayer):
        return tuple(layer.kernel_matrices().shape)
    known = supported_class(layer, einsums)
    if known is nnx.Conv:
        sizes, (*outer, _, d_out) = layer.kernel_size, layer.kernel.get_value().shape
        outer = outer[: len(outer) - len(sizes)]
        return (*outer, math.prod(layer.kernel.get_value().shape[len(outer) : -1]), d_out)
    if known in (nnx.Linear, nnx.Embed):
        return kernel_of(layer).get_value().shape
    name, equation = kernel_and_equation(layer, known, einsums)
    value = getattr(layer, name).get_value()
    shaped = jax.ShapeDtypeStruct(value.shape, value.dtype)
    return jax.eval_shape(lambda kernel: einsum.to_matrices(equation, kernel), shaped).shape


def kernel_of(layer: Any) -> nnx.Param[Any]:
    """The kernel variable of a supported layer, adapted or not."""
    name = "embedding" if isinstance(layer, nnx.Embed) else "kernel"
    return getattr(layer, getattr(layer, "kernel_name", name))


def check_settings(layer: Any) -> None:
    """Raise ValueError for settings that adapted layers do not support."""
    for name, defaults in _DEFAULT_SETTINGS.items():
        if getattr(layer, name, defaults[0]) not in defaults:
            raise ValueError(f"{type(layer).__name__} with a custom {name} cannot be adapted")


def to_dense(linear: Dense | nnx.Linear) -> Dense:
    """Convert `nnx.Linear` to a `Dense` that shares its variables; a `Dense` is returned as is.

    Raises:
        ValueError: the layer has a custom matmul or precision.
    """
    if isinstance(linear, Dense):
        return linear
    check_settings(linear)
    has_bias, zeros = linear.bias is not None, nnx.initializers.zeros
    layer = Dense(1, 1, use_bias=has_bias, dtype=linear.dtype, kernel_init=zeros, rngs=nnx.Rngs(0))
    layer.kernel, layer.bias = linear.kernel, linear.bias
    return layer


@functools.cache
def _mixed_class(mixin: type[AdaptedLayer], base: type[nnx.Module]) -> type[AdaptedLayer]:
    """Subclass of mixin and base, cached so that equal models have equal graph definitions."""
    return type(f"Adapted{base.__name__}", (mixin, base), {"__doc__": mixin.__doc__})


def _with_mixin(
    layer: nnx.Module, mixin: type[AdaptedLayer], name: str, equation: str | None = None
) -> AdaptedLayer:
    """Copy a layer, sharing its variables, with the mixin added to its class.

    `name` is the kernel's attribute name. Raises ValueError if the layer already has an attribute
    that the mixin needs.
    """
    names = ("adapter", "method", "kernel_name") + (("kernel_equation",) if equation else ())
    if taken := [name for name in names if hasattr(layer, name)]:
        raise ValueError(f"{type(layer).__name__} already has an attribute {taken[0]!r}")
    new = _with_class(layer, _mixed_class(mixin, type(layer)))
    new.adapter, new.method, new.kernel_name = nnx.data(None), None, name
    if equation:
        new.kernel_equation = equation
    return new


def _restore_class(layer: AdaptedLayer) -> Any:
    """Undo `_with_mixin`, keeping the layer's current variables."""
    original = _with_class(layer, type(layer).__bases__[1])
    del original.adapter, original.method, original.kernel_name
    return original


def _with_class(layer: nnx.Module, kind: type[nnx.Module]) -> Any:
    """Copy a layer as an instance of another class, without calling `__init__`."""
    new = object.__new__(kind)
    vars(new).update(vars(layer))
    return new
