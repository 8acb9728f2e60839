"""Determine from one call of a Linen layer how it uses its kernel."""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import numpy as np

from lorasp_jax.adapters.layers import nnx_layers
from lorasp_jax.adapters.layers.einsum import (
    LINEAR,
    einsum,
    from_matrices,
    general_equation,
    to_matrices,
)
from lorasp_jax.dense import cast_input
from lorasp_jax.peft import Aux, Method
from lorasp_jax.peft.method import check_params, dropout, dropout_rate


def _general(layer: Any) -> tuple[str, str]:
    axis, batch, features = (
        (value,) if isinstance(value, int) else tuple(value)
        for value in (layer.axis, layer.batch_dims, layer.features)
    )
    return "kernel", general_equation(axis, batch, len(features))


EINSUMS: nnx_layers.Einsums = {
    nn.Dense: lambda _: ("kernel", LINEAR),
    nn.DenseGeneral: _general,
    nn.Einsum: lambda layer: ("kernel", layer.einsum_str),
}


def supported_class(module: nn.Module, einsums: nnx_layers.Einsums) -> type[nn.Module] | None:
    """Supported class whose `__call__` the layer uses; None if it overrides `__call__`."""
    classes = (nn.Embed, nn.Conv, *EINSUMS, *einsums)
    matches = (cls for cls in classes if isinstance(module, cls))
    return next((cls for cls in matches if type(module).__call__ is cls.__call__), None)


class LayerCall(NamedTuple):
    """The kernel, equation and input of a layer in one call.

    Attributes:
        module: the layer.
        name: parameter name of the kernel.
        equation: the einsum's equation; None for an embedding or a convolution.
        x: the einsum's input.
    """

    module: nn.Module
    name: str
    equation: str | None = None
    x: Any = None

    def kernel(self) -> jax.Array:
        """The kernel, without any sharding metadata box."""
        return nn.meta.unbox(self.module.get_variable("params", self.name))

    def matrices(self) -> jax.Array:
        """The kernel as a stack of matrices [*batch, I, O], as its adapter uses it."""
        kernel = self.kernel()
        if self.equation is None:
            return kernel.reshape(-1, kernel.shape[-1])
        return to_matrices(self.equation, kernel)

    def set_matrices(self, matrices: jax.Array) -> None:
        """Replace the layer's kernel, keeping its sharding metadata box."""
        shape = self.kernel().shape
        if self.equation is None:
            kernel = matrices.reshape(shape)
        else:
            kernel = from_matrices(self.equation, matrices, shape)
        boxed = nn.meta.replace_boxed(self.module.get_variable("params", self.name), kernel)
        self.module.put_variable("params", self.name, boxed)

    def adapter_init(self, method: Method) -> Callable[[jax.Array, jax.Array], Any]:
        """Function (key, kernel [I, O]) that initializes a method's parameters.

        Raises:
            ValueError: the layer does not support the method.
        """
        return method.init if self.equation else nnx_layers.lora_init(self.module, method)

    def einsum(self, method: Method, params: Any, key: Any) -> tuple[jax.Array, Aux]:
        """The adapted einsum plus bias, and aux."""
        assert self.equation is not None
        kernel, bias = self.kernel(), nn.meta.unbox(self.module.get_variable("params", "bias"))
        *batch, d_in, d_out = jax.eval_shape(self.matrices).shape
        single = jax.eval_shape(lambda: jax.tree.map(lambda p: p[(0,) * len(batch)], params))
        check_params(method, single, (d_in, d_out))  # the user passes them with each call
        x = cast_input(getattr(self.module, "dtype", None), self.x, kernel)
        return einsum(self.equation, x, kernel, bias, params, method, key)


def layer_call(module: nn.Module, einsums: nnx_layers.Einsums, args: Any, kwargs: Any) -> LayerCall:
    """Inspect a call of a supported layer.

    Raises:
        ValueError: the layer has a custom matmul or precision, or its equation, input or kernel is
            missing.
    """
    cls = supported_class(module, einsums)
    if cls is nn.Embed or cls is nn.Conv:
        return LayerCall(module, "embedding" if cls is nn.Embed else "kernel")
    assert cls is not None
    nnx_layers.check_settings(module)
    name, equation = nnx_layers.describe_einsum({**EINSUMS, **einsums}[cls], module)
    arguments = [*args, *kwargs.values()]
    strings = [value for value in arguments if isinstance(value, str)]
    arrays = [value for value in arguments if isinstance(value, jax.Array | np.ndarray)]
    if equation is None and not strings:
        raise ValueError(f"this {cls.__name__} was called without its equation")
    if not arrays or not module.has_variable("params", name):
        lacks = f"parameter {name!r}" if arrays else "input"
        raise ValueError(f"this {cls.__name__} has no {lacks}")
    return LayerCall(module, name, equation or strings[0], arrays[0])


def with_lora(
    module: nn.Module, method: Any, params: Any, key: Any, y: jax.Array, inputs: jax.Array
) -> tuple[jax.Array, Aux]:
    """Add LoRA's delta to the output y of an embedding or a convolution; return y and aux."""
    a = params["lora_a"]
    conv = isinstance(module, nn.Conv)
    if conv and key is not None:
        inputs = dropout(inputs, dropout_rate(method), key)
    hidden = nnx_layers.convolve(module, a, inputs) if conv else nnx_layers.lookup(a, inputs)
    z, aux = method.bottleneck(params, hidden.astype(y.dtype), None)
    return y + z @ method.up(params).astype(y.dtype), aux
