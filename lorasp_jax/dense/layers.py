"""What layers with an adapter have in common, and the drop-in for Flax NNX's `nnx.Linear`."""

import contextlib
from collections.abc import Callable
from typing import Any

import flax.errors
import jax
import jax.numpy as jnp
from flax import nnx
from flax.typing import Dtype, Initializer

from lorasp_jax.dense import validate
from lorasp_jax.dense.functional import DenseLayer, cast_input, dense
from lorasp_jax.kernels.quantized_weights import QuantizedKernel
from lorasp_jax.peft import Aux, Method
from lorasp_jax.peft._fields import short
from lorasp_jax.peft._method import Params

AUX_NAME = "stored_aux"
KERNEL_INIT = jax.nn.initializers.lecun_normal()  # of nnx.Linear and nn.Dense too


class AdapterParam(nnx.LoRAParam[Any]):
    """What trains, and the only thing that does: an adapter's parameters, or a base weight."""


class AdapterAux(nnx.Intermediate[Any]):
    """What a drop-in layer kept in its last call."""


def reject_out_sharding(out_sharding: Any) -> None:
    """Raises a ValueError unless it is None: some models pass it to every layer."""
    if out_sharding is not None:
        raise ValueError("an adapted layer takes no out_sharding: constrain what it returns.")


class DropoutKey(nnx.Variable[Any]):
    """What `with_dropout` gives a layer for one training step."""


def with_value(variable: Any, value: Any) -> Any:
    """A variable of its own with another value: the old one may be shared with other layers."""
    return type(variable)(value, **variable.get_metadata())


class AdaptedLayer(nnx.Module):
    """A layer that can carry an adapter: what adaptation, tables and files know of it.

    Attributes:
      kernel_name: name of the attribute that holds the layer's kernel.
      adapter: `AdapterParam` holding the method's parameters, or None.
      method: the adapter's method, static.
      stored_aux: aux of the last call. Absent if there is none, so that the graph structure of the
        layer does not change.
      stored_dropout_key: the key set by `with_dropout`, absent otherwise.
    """

    kernel_name: str = "kernel"
    adapter: AdapterParam | None
    method: Method | None
    stored_aux: AdapterAux
    stored_dropout_key: DropoutKey

    def kernel_matrices(self) -> jax.Array:
        """The kernel as the adapter sees it, [..., I, O]; leading axes are stacks of layers."""
        kernel = self.kernel_variable()
        if not isinstance(kernel, nnx.Variable):
            raise ValueError(f"its {self.kernel_name} is {short(kernel)}, no parameter.")
        return kernel.get_value()

    def kernel_variable(self) -> Any:
        """What holds the kernel, under whichever name the layer's own class gives it."""
        return getattr(self, self.kernel_name)

    def set_kernel_variable(self, variable: Any) -> None:
        """Gives the layer what holds another kernel, or one shared with other layers."""
        setattr(self, self.kernel_name, variable)

    def stack_shape(self) -> tuple[int, ...]:
        """Sizes of the stacks of layers that this one is; () for one layer."""
        return tuple(self.kernel_matrices().shape[:-2])

    def set_kernel_matrices(self, matrices: jax.Array | QuantizedKernel) -> None:
        """Gives the layer another kernel in a variable of its own: the old one may be shared."""
        old = self.kernel_variable()
        self.set_kernel_variable(with_value(old, matrices.reshape(old.get_value().shape)))

    def adapter_init(self, method: Method) -> Callable[[jax.Array, jax.Array], tuple[Params, Any]]:
        """What makes a method's parameters, and the kernel it leaves, from a key and one [I, O].

        Raises:
          ValueError: a method that this kind of layer cannot carry.
        """
        return method.init

    def method_and_params(self) -> tuple[Method, Params]:
        """The method and the parameters of an adapter that is there."""
        assert self.method is not None
        assert self.adapter is not None
        return self.method, self.adapter.get_value()

    def without_adapter(self) -> nnx.Module:
        """The layer as it was before adaptation, or as near as it comes, with its kernel of now.

        One of another class is a new object that shares the variables.
        """
        self.adapter, self.method = None, None
        return self

    @property
    def dropout_key(self) -> jax.Array | None:
        """The key of `with_dropout`, or None: nothing is dropped."""
        held = getattr(self, "stored_dropout_key", None)
        return None if held is None else held.get_value()

    def store_aux(self, aux: Aux) -> None:
        """Stores aux for `collect_aux`, where the layer may be changed."""
        # A module of an outer trace cannot be changed; collect_aux then raises.
        with contextlib.suppress(flax.errors.TraceContextError):
            self.stored_aux = AdapterAux(aux)


class Dense(AdaptedLayer):
    """A dense layer with an optional adapter, a drop-in for `nnx.Linear`.

    Attributes:
      kernel: [I, O] (an `AdapterParam` under full fine-tuning). In a model that scans over its
        depth it carries leading layer axes, and so does the adapter.
      bias: [O] or None.
      adapter: `AdapterParam` holding the method's parameters, or None.
      method: the adapter's method, static.
    """

    def __init__(
        self,
        d_in: int,
        d_out: int,
        *,
        use_bias: bool = True,
        method: Method | None = None,
        dtype: Dtype | None = None,
        param_dtype: Dtype = jnp.float32,
        kernel_init: Initializer = KERNEL_INIT,
        rngs: nnx.Rngs,
    ) -> None:
        """Draws the weights.

        Args:
          d_in: I.
          d_out: O.
          use_bias: whether to add a bias, zero at first.
          method: adapter method, or None.
          dtype: type of the computation; None promotes input and kernel.
          param_dtype: type of kernel and bias; adapters are always fp32.
          kernel_init: initializer of the kernel.
          rngs: source of the random keys.

        Raises:
          ValueError: what is no width, method or source of keys.
        """
        d_in, d_out = validate.size("d_in", d_in), validate.size("d_out", d_out)
        validate.method(method)
        validate.rngs(rngs)
        validate.floating_dtype("param_dtype", param_dtype)
        validate.floating_dtype("dtype", dtype or param_dtype)
        base = AdapterParam if method is not None and method.trains_base else nnx.Param
        self.kernel: nnx.Param[Any] = base(kernel_init(rngs.params(), (d_in, d_out), param_dtype))
        bias = base(jnp.zeros(d_out, param_dtype)) if use_bias else None
        self.bias: nnx.Param[Any] | None = bias
        self.adapter = nnx.data(None)  # may hold a variable later
        self.method = method
        self.dtype = dtype
        if method is not None and not method.trains_base:
            params, kernel = method.init(rngs.params(), self.kernel.get_value())
            self.kernel.set_value(kernel)
            self.adapter = AdapterParam(params)

    def __call__(
        self,
        x: jax.Array,
        *,
        token_mask: jax.Array | None = None,
        return_aux: bool = False,
        out_sharding: None = None,
    ) -> Any:
        """y [...tokens, O], or (y, aux) if asked; see `dense`. An output sharding is refused."""
        reject_out_sharding(out_sharding)
        y, aux = dense(self.cast_input(x), *self.arrays(), token_mask=token_mask)
        if return_aux:
            return y, aux
        if self.adapter is not None:
            self.store_aux(aux)
        return y

    def cast_input(self, x: jax.Array) -> jax.Array:
        """x in the type of the computation."""
        return cast_input(self.dtype, x, self.kernel.get_value())

    def arrays(self) -> DenseLayer:
        """What `dense` and `dense_shared_input` take."""
        bias = None if self.bias is None else self.bias.get_value()
        params = None if self.adapter is None else self.adapter.get_value()
        return DenseLayer(self.kernel.get_value(), bias, params, self.method, self.dropout_key)
