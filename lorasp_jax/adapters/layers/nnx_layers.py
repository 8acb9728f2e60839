"""Layers of other people's NNX models with an adapter inside: einsums, lookups, convolutions.

An adapted layer takes the layer's place with the same attributes and its class as a base class, so
that what the model reads of it is still there; `without_adapter` gives one of the old class again.
`nnx.Linear` becomes a `Dense`.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen, nnx

from lorasp_jax import _compat
from lorasp_jax.adapters.layers import einsum
from lorasp_jax.dense import AdaptedLayer, Dense, cast_input, reject_out_sharding, with_value
from lorasp_jax.kernels.quantized_weights import QuantizedKernel
from lorasp_jax.peft import LoRA, Method
from lorasp_jax.peft._fields import short
from lorasp_jax.peft._method import dropout, dropout_rate

Einsums = Mapping[type, Callable[[Any], tuple[str, str | None]]]
"""By layer class, of NNX or Linen: a function of the layer that gives the name of its kernel and
its equation; None where the equation comes with the call, as a text, which only Linen's may."""

EINSUMS: Einsums = {
    nnx.LinearGeneral: lambda layer: (
        "kernel",
        einsum.general_equation(layer.axis, tuple(layer.batch_axis), len(layer.out_features)),
    ),
    nnx.Einsum: lambda layer: ("kernel", layer.einsum_str),
}
# Settings that an adapted layer does not follow, and the values that ask for nothing.
_PLAIN: dict[str, tuple[Any, ...]] = {
    "dot_general": (None, jax.lax.dot_general),
    "dot_general_cls": (None,),
    "einsum_op": (jnp.einsum,),
    "precision": (None,),
    "preferred_element_type": (None,),
    "promote_dtype": (_compat.nnx_promote_dtype, linen.dtypes.promote_dtype),
}


class EinsumLayer(AdaptedLayer):
    """Mixin for a layer that is an einsum of its input and its kernel.

    Attributes:
      kernel_equation: the einsum, see `lorasp_jax.adapters.layers.einsum`.
    """

    kernel_equation: str

    def __call__(self, x: jax.Array, *, out_sharding: None = None) -> jax.Array:
        """y, see `einsum.einsum`.

        Raises:
          ValueError: an output sharding was asked for.
        """
        reject_out_sharding(out_sharding)
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
        """As for every layer; axes of the einsum are none of them."""
        shape = super().kernel_matrices().shape
        return tuple(shape[: len(shape) - len(einsum.parse(self.kernel_equation).kernel)])

    def set_kernel_matrices(self, matrices: jax.Array | QuantizedKernel) -> None:
        """Gives the layer another kernel."""
        old = self.kernel_variable()
        kernel = einsum.from_matrices(self.kernel_equation, matrices, old.get_value().shape)
        self.set_kernel_variable(with_value(old, kernel))

    def without_adapter(self) -> nnx.Module:
        """The layer in its own class again, unless that cannot read a quantised kernel."""
        if isinstance(super().kernel_matrices(), QuantizedKernel):
            return super().without_adapter()
        layer = _plain(self)
        del layer.kernel_equation
        return layer


class LoRALayer(AdaptedLayer):
    """Mixin for a layer that adds LoRA's low-rank map, or several, to what its class computes."""

    def adapter_init(self, method: Method) -> Callable[[jax.Array, jax.Array], Any]:
        """As for every layer, but see `lora_init`."""
        return lora_init(self, method)

    def with_delta(self, y: jax.Array, read: Callable[[jax.Array], jax.Array]) -> jax.Array:
        """Y plus the delta, from what `read` makes of the input and A."""
        method, params = self.method_and_params()
        z, aux = method.bottleneck(params, read(method.down(params)).astype(y.dtype), None)
        self.store_aux(aux)
        return y + z @ method.up(params).astype(y.dtype)

    def without_adapter(self) -> nnx.Module:
        """The layer in its own class again."""
        return _plain(self)


class EmbedLayer(LoRALayer):
    """Mixin for `nnx.Embed`: the rows looked up, and the logits of `attend`, see W + scale A B."""

    def __call__(self, inputs: jax.Array, *args: Any, **kwargs: Any) -> jax.Array:
        """Rows of the table for ids [...], [..., D]."""
        y = super().__call__(inputs, *args, **kwargs)
        return self.with_delta(y, lambda a: lookup(a, inputs))

    def attend(self, query: jax.Array, *args: Any, **kwargs: Any) -> jax.Array:
        """Inner products of queries [..., D] with the rows, [..., V]."""
        y = super().attend(query, *args, **kwargs)
        return y + attend_delta(*self.method_and_params(), query.astype(y.dtype))


class ConvLayer(LoRALayer):
    """Mixin for `nnx.Conv`: A is a convolution onto R channels, B one of size 1."""

    def __call__(self, inputs: jax.Array, *args: Any, **kwargs: Any) -> jax.Array:
        """The convolution, [..., *spatial, O]."""
        y = super().__call__(inputs, *args, **kwargs)
        if self.dropout_key is not None:
            inputs = dropout(inputs, dropout_rate(self.method), self.dropout_key)
        return self.with_delta(y, lambda a: convolved(self, a, inputs))

    def kernel_matrices(self) -> jax.Array:
        """The kernel [..., *sizes, I, O] as [..., sizes · I, O]."""
        kernel = super().kernel_matrices()
        outer = kernel.ndim - len(self.kernel_size) - 2
        return kernel.reshape(*kernel.shape[:outer], -1, kernel.shape[-1])


def lookup(table: jax.Array, ids: jax.Array) -> jax.Array:
    """Rows of a table for ids, as `nnx.Embed` finds them: one row serves any id."""
    if table.shape[0] == 1:
        return jnp.broadcast_to(table, (*ids.shape, table.shape[1]))
    return jnp.take(table, ids, axis=0)


def attend_delta(method: Method, params: Any, query: jax.Array) -> jax.Array:
    """What scale A B adds to the inner products of queries [..., D] with a table's rows."""
    down, up = (side.astype(query.dtype) for side in (method.down(params), method.up(params)))
    return method.bottleneck(params, query @ up.T, None)[0].astype(query.dtype) @ down.T


def convolved(layer: Any, a: jax.Array, inputs: jax.Array) -> jax.Array:
    """inputs [..., *spatial, I] under A [sizes · I, R], moved over them like the layer's kernel.

    Args:
      layer: a convolution of NNX or Linen; their settings have the same names.
      a: LoRA's A.
      inputs: the layer's input.
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
    """What makes LoRA's parameters for an embedding or a convolution from a key and a kernel.

    Raises:
      ValueError: another method, or a convolution in groups or with a mask.
    """
    if type(method) is not LoRA or method.splits_kernel or method.needs_statistics:
        raise ValueError(
            f"{type(layer).__name__} takes LoRA that starts without the kernel or data, not "
            f"{method}: put a rule with None, or with such a LoRA, in front."
        )
    if not isinstance(layer, nnx.Conv | linen.Conv):
        return method.init_table
    if layer.feature_group_count != 1 or layer.mask is not None:
        raise ValueError("a convolution in groups or with a mask cannot be adapted.")
    return method.init


def adapted(layer: nnx.Module, einsums: Einsums) -> AdaptedLayer:
    """The layer as one that can carry an adapter.

    Args:
      layer: of a known kind; left as it is, but one with an adapter is returned itself.
      einsums: further layer classes that are einsums.

    Raises:
      ValueError: a layer with its own matrix product, precision or the like.
    """
    if isinstance(layer, AdaptedLayer):
        return layer
    known = kind(layer, einsums)
    if isinstance(layer, nnx.Linear) and known is nnx.Linear:
        return as_dense(layer)
    if known not in (nnx.Embed, nnx.Conv):
        check_plain(layer)
    if known is nnx.Embed:
        return _carrying(layer, EmbedLayer, "embedding")
    if known is nnx.Conv:
        return _carrying(layer, ConvLayer, "kernel")
    name, equation = kernel_and_equation(layer, known, einsums)
    return _carrying(layer, EinsumLayer, name, equation)


def like(layer: Any, other: AdaptedLayer) -> AdaptedLayer:
    """The layer as one that can carry the adapters of another, which has been adapted.

    Args:
      layer: of the other's kind, adapted or not; left as it is, but one that can carry adapters is
        returned itself.
      other: not modified.

    Raises:
      ValueError: a layer of another class.
    """
    if isinstance(layer, type(other)):
        return layer
    mixin, plain = (Dense, nnx.Linear) if isinstance(other, Dense) else type(other).__bases__
    if not isinstance(layer, plain):
        raise ValueError(f"a {type(layer).__name__} is there instead of a {plain.__name__}.")
    if mixin is Dense:
        return as_dense(layer)
    return _carrying(layer, mixin, other.kernel_name, getattr(other, "kernel_equation", None))


def kind(layer: Any, einsums: Einsums) -> type[nnx.Module] | None:
    """The known class that the layer is called as; a subclass with a call of its own has none."""
    known = (nnx.Linear, nnx.Embed, nnx.Conv, *EINSUMS, *einsums)
    calls = (cls for cls in known if isinstance(layer, cls))
    return next((cls for cls in calls if type(layer).__call__ is cls.__call__), None)


def kernel_and_equation(layer: Any, known: type | None, einsums: Einsums) -> tuple[str, str]:
    """The name of an einsum layer's kernel and its equation.

    Raises:
      ValueError: an equation that is no adaptable map, or no such kernel.
    """
    assert known is not None
    name, equation = described({**EINSUMS, **einsums}[known], layer)
    if equation is None:
        raise ValueError(f"the equation of a {type(layer).__name__} must be known before its call.")
    if not isinstance(getattr(layer, name, None), nnx.Param):
        raise ValueError(f"a {type(layer).__name__} has no parameter {name!r}.")
    einsum.parse(equation)
    return name, equation


def check_einsums(einsums: Any) -> None:
    """Raises a ValueError unless these are layer classes with a function each."""
    pairs = einsums.items() if isinstance(einsums, Mapping) else [(None, None)]
    if not all(isinstance(cls, type) and callable(describe) for cls, describe in pairs):
        raise ValueError(
            "einsums are {layer class: function of a layer that gives (its kernel's name, "
            f"equation)}}, got {short(einsums)}."
        )


def described(describe: Callable[[Any], Any], layer: Any) -> tuple[str, str | None]:
    """What a function of `Einsums` says of a layer; raises a ValueError if that is nothing."""
    try:
        name, equation = describe(layer)
    except (TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"einsums cannot describe a {type(layer).__name__}: {error}") from error
    if not isinstance(name, str) or not isinstance(equation, str | None):
        raise ValueError(f"einsums give (name, equation), got {short((name, equation))}.")
    return name, equation


def matrices_shape(layer: Any, einsums: Einsums) -> tuple[int, ...]:
    """[..., *batch, I, O], the shape of a layer's kernel as an adapter sees it.

    Args:
      layer: dense or an einsum, adapted or not.
      einsums: further layer classes that are einsums.

    Raises:
      ValueError: an equation that is no adaptable map.
    """
    if isinstance(layer, AdaptedLayer):
        return tuple(layer.kernel_matrices().shape)
    known = kind(layer, einsums)
    if known is nnx.Linear:
        return layer.kernel.get_value().shape
    name, equation = kernel_and_equation(layer, known, einsums)
    value = getattr(layer, name).get_value()
    shaped = jax.ShapeDtypeStruct(value.shape, value.dtype)
    return jax.eval_shape(lambda kernel: einsum.to_matrices(equation, kernel), shaped).shape


def kernel_of(layer: Any) -> nnx.Param[Any]:
    """The kernel of a layer of a known kind, adapted or not."""
    name = "embedding" if isinstance(layer, nnx.Embed) else "kernel"
    return getattr(layer, getattr(layer, "kernel_name", name))


def check_plain(layer: Any) -> None:
    """Raises a ValueError for settings that an adapted layer would not follow."""
    for name, plain in _PLAIN.items():
        if getattr(layer, name, plain[0]) not in plain:
            raise ValueError(
                f"a {type(layer).__name__} with its own dot_general or precision cannot be "
                f"adapted: it sets {name}."
            )


def as_dense(linear: Dense | nnx.Linear) -> Dense:
    """A `Dense` that holds a linear layer's own variables; one that is there already as it is.

    Raises:
      ValueError: a layer with its own matrix product, precision or the like.
    """
    if isinstance(linear, Dense):
        return linear
    check_plain(linear)
    has_bias, zeros = linear.bias is not None, nnx.initializers.zeros
    layer = Dense(1, 1, use_bias=has_bias, dtype=linear.dtype, kernel_init=zeros, rngs=nnx.Rngs(0))
    layer.kernel, layer.bias = linear.kernel, linear.bias
    return layer


@functools.cache
def _class(mixin: type[AdaptedLayer], base: type[nnx.Module]) -> type[AdaptedLayer]:
    """One class for each base, so that equal models have equal graph definitions."""
    return type(f"Adapted{base.__name__}", (mixin, base), {"__doc__": mixin.__doc__})


def _carrying(
    layer: nnx.Module, mixin: type[AdaptedLayer], name: str, equation: str | None = None
) -> AdaptedLayer:
    """A layer that shares the variables of one and has the mixin in front of its class.

    Args:
      layer: left as it is.
      mixin: what it does with an adapter.
      name: of its kernel.
      equation: of an einsum.

    Raises:
      ValueError: the layer has an attribute of a name that is needed.
    """
    names = ("adapter", "method", "kernel_name") + (("kernel_equation",) if equation else ())
    if taken := [name for name in names if hasattr(layer, name)]:
        raise ValueError(f"{type(layer).__name__} has an attribute {taken[0]} of its own.")
    new = _in_class(layer, _class(mixin, type(layer)))
    new.adapter, new.method, new.kernel_name = nnx.data(None), None, name
    if equation:
        new.kernel_equation = equation
    return new


def _plain(layer: AdaptedLayer) -> Any:
    """What `_carrying` was given, with the variables of now."""
    plain = _in_class(layer, type(layer).__bases__[1])
    del plain.adapter, plain.method, plain.kernel_name
    return plain


def _in_class(layer: nnx.Module, kind: type[nnx.Module]) -> Any:
    """A layer of another class with the same attributes, of which one class adds none to the other.

    Like copies of `copy.copy`, it does not run `__init__`, whose arguments nobody knows any more.
    """
    new = object.__new__(kind)
    vars(new).update(vars(layer))
    return new
