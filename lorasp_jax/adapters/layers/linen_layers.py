"""What the layers of Linen models do with their kernels, seen from one call of a layer."""

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
from lorasp_jax.peft._method import dropout, dropout_rate


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


def kind(module: nn.Module, einsums: nnx_layers.Einsums) -> type[nn.Module] | None:
    """The known class that the layer is called as; a subclass with a call of its own has none."""
    known = (nn.Embed, nn.Conv, *EINSUMS, *einsums)
    calls = (cls for cls in known if isinstance(module, cls))
    return next((cls for cls in calls if type(module).__call__ is cls.__call__), None)


class LayerMap(NamedTuple):
    """What a layer does in a call.

    Attributes:
      module: the layer.
      name: its kernel's name among its parameters.
      equation: for einsums; None for an embedding or a convolution.
      x: the einsum's input.
    """

    module: nn.Module
    name: str
    equation: str | None = None
    x: Any = None

    def kernel(self) -> jax.Array:
        """The kernel without the box of sharding metadata it may be in."""
        return nn.meta.unbox(self.module.get_variable("params", self.name))

    def matrices(self) -> jax.Array:
        """The kernel as its adapter sees it, [*batch, I, O]."""
        kernel = self.kernel()
        if self.equation is None:
            return kernel.reshape(-1, kernel.shape[-1])
        return to_matrices(self.equation, kernel)

    def put_matrices(self, matrices: jax.Array) -> None:
        """Gives the layer another kernel, in the same box."""
        shape = self.kernel().shape
        if self.equation is None:
            kernel = matrices.reshape(shape)
        else:
            kernel = from_matrices(self.equation, matrices, shape)
        boxed = nn.meta.replace_boxed(self.module.get_variable("params", self.name), kernel)
        self.module.put_variable("params", self.name, boxed)

    def adapter_init(self, method: Method) -> Callable[[jax.Array, jax.Array], Any]:
        """What makes a method's parameters from a key and a kernel [I, O].

        Raises:
          ValueError: a method that this kind of layer cannot carry.
        """
        return method.init if self.equation else nnx_layers.lora_init(self.module, method)

    def einsum(self, method: Method, params: Any, key: Any) -> tuple[jax.Array, Aux]:
        """The einsum through an adapter, plus bias; and aux."""
        assert self.equation is not None
        kernel, bias = self.kernel(), nn.meta.unbox(self.module.get_variable("params", "bias"))
        x = cast_input(getattr(self.module, "dtype", None), self.x, kernel)
        return einsum(self.equation, x, kernel, bias, params, method, key)


def layer_map(module: nn.Module, einsums: nnx_layers.Einsums, args: Any, kwargs: Any) -> LayerMap:
    """What a layer of a known kind does in a call with these arguments.

    Raises:
      ValueError: a layer with its own matrix product, precision or the like.
    """
    known = kind(module, einsums)
    if known is nn.Embed or known is nn.Conv:
        return LayerMap(module, "embedding" if known is nn.Embed else "kernel")
    assert known is not None
    nnx_layers.check_plain(module)
    name, equation = nnx_layers.described({**EINSUMS, **einsums}[known], module)
    given = [*args, *kwargs.values()]
    texts = [value for value in given if isinstance(value, str)]
    arrays = [value for value in given if isinstance(value, jax.Array | np.ndarray)]
    if equation is None and not texts:
        raise ValueError(f"a {known.__name__} was called without the equation it was to get.")
    if not arrays or not module.has_variable("params", name):
        lacks = f"parameter {name!r}" if arrays else "input"
        raise ValueError(f"a {known.__name__} has no {lacks}.")
    return LayerMap(module, name, equation or texts[0], arrays[0])


def with_lora(
    module: nn.Module, method: Any, params: Any, key: Any, y: jax.Array, inputs: jax.Array
) -> tuple[jax.Array, Aux]:
    """y of an embedding or a convolution plus the delta, and aux."""
    a = params["lora_a"]
    conv = isinstance(module, nn.Conv)
    if conv and key is not None:
        inputs = dropout(inputs, dropout_rate(method), key)
    hidden = nnx_layers.convolved(module, a, inputs) if conv else nnx_layers.lookup(a, inputs)
    z, aux = method.bottleneck(params, hidden.astype(y.dtype), None)
    return y + z @ method.up(params).astype(y.dtype), aux
