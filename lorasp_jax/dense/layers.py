"""Base class of adapted layers, and the drop-in for Flax NNX's `nnx.Linear`."""

import contextlib
from collections.abc import Callable
from typing import Any, NoReturn

import flax.errors
import jax
import jax.numpy as jnp
from flax import nnx
from flax.typing import Dtype, Initializer

from lorasp_jax.dense import validate
from lorasp_jax.dense.functional import DenseLayer, apply_layer, cast_input
from lorasp_jax.kernels.quantized_weights import QuantizedKernel
from lorasp_jax.peft import Aux, Method
from lorasp_jax.peft.fields import short
from lorasp_jax.peft.method import Mask, Params, check_params

AUX_NAME = "stored_aux"
KERNEL_INIT = jax.nn.initializers.lecun_normal()  # same as nnx.Linear and nn.Dense


class AdapterParam(nnx.LoRAParam[Any]):
    """A parameter to train: an adapter's, or a base weight. No other variables are trained."""


class AdapterAux(nnx.Intermediate[Any]):
    """Aux of a drop-in layer's last call."""


def reject_out_sharding() -> NoReturn:
    """Raise ValueError. Some models pass out_sharding to every layer."""
    raise ValueError(
        "adapted layers do not support out_sharding: constrain the output's sharding instead"
    )


class DropoutKey(nnx.Variable[Any]):
    """Dropout key of a layer for one training step, set by `with_dropout`."""


def with_value(variable: Any, value: Any) -> Any:
    """Return a new variable with the same metadata, since other layers may share the old one."""
    return type(variable)(value, **variable.get_metadata())


class AdaptedLayer(nnx.Module):
    """A layer that can have an adapter: the interface used by adaptation, summaries and file I/O.

    Attributes:
        kernel_name: attribute name of the layer's kernel.
        adapter: `AdapterParam` holding the method's parameters, or None.
        method: the adapter's method, static.
        stored_aux: aux of the last call. The attribute is absent before the first call, so that it
            is not part of the layer's graph structure.
        stored_dropout_key: the key set by `with_dropout`; absent otherwise.
    """

    kernel_name: str = "kernel"
    adapter: AdapterParam | None
    method: Method | None
    stored_aux: AdapterAux
    stored_dropout_key: DropoutKey

    def kernel_matrices(self) -> jax.Array:
        """The kernel as matrices [..., I, O]; leading axes index stacked layers."""
        kernel = self.kernel_variable()
        if not isinstance(kernel, nnx.Variable):
            raise ValueError(f"its {self.kernel_name} must be an nnx.Variable, got {short(kernel)}")
        return kernel.get_value()

    def kernel_variable(self) -> Any:
        """The variable that holds the kernel."""
        return getattr(self, self.kernel_name)

    def set_kernel_variable(self, variable: Any) -> None:
        """Replace the variable that holds the kernel; layers that share the old one keep it."""
        setattr(self, self.kernel_name, variable)

    def stack_shape(self) -> tuple[int, ...]:
        """Leading axes of a stack of layers; () for a single layer."""
        return tuple(self.kernel_matrices().shape[:-2])

    def set_kernel_matrices(self, matrices: jax.Array | QuantizedKernel) -> None:
        """Set the kernel in a new variable, because the old one may be shared."""
        old = self.kernel_variable()
        self.set_kernel_variable(with_value(old, matrices.reshape(old.get_value().shape)))

    def adapter_init(self, method: Method) -> Callable[[jax.Array, jax.Array], tuple[Params, Any]]:
        """Return the initializer (key, kernel [I, O]) -> (params, kernel or residual).

        Raises:
            ValueError: this kind of layer does not support the method.
        """
        return method.init

    def method_and_params(self) -> tuple[Method, Params]:
        """The adapter's method and parameters; the layer must have an adapter."""
        assert self.method is not None
        assert self.adapter is not None
        return self.method, self.adapter.get_value()

    def without_adapter(self) -> nnx.Module:
        """Return the layer without its adapter, with its current kernel.

        If adaptation changed the class, this is a new object that shares the variables.
        """
        self.adapter, self.method = None, None
        return self

    @property
    def dropout_key(self) -> jax.Array | None:
        """The key set by `with_dropout`, or None if dropout is off."""
        key = getattr(self, "stored_dropout_key", None)
        return None if key is None else key.get_value()

    def store_aux(self, aux: Aux) -> None:
        """Store aux for `collect_aux` if the layer is mutable."""
        # A module created in an outer trace is immutable; collect_aux then raises.
        with contextlib.suppress(flax.errors.TraceContextError):
            self.stored_aux = AdapterAux(aux)


class Dense(AdaptedLayer):
    """A dense layer with an optional adapter, a drop-in for `nnx.Linear`.

    Attributes:
        kernel: [I, O] (an `AdapterParam` under full fine-tuning). In a model that scans over its
            layers, kernel and adapter have leading layer axes.
        bias: [O] or None.
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
        """Initialize the weights.

        Args:
            d_in: I.
            d_out: O.
            use_bias: whether to add a bias, initially zero.
            method: adapter method, or None.
            dtype: compute dtype; None promotes the dtypes of input and kernel.
            param_dtype: dtype of kernel and bias; adapters are always fp32.
            kernel_init: initializer of the kernel.
            rngs: source of the random keys.

        Raises:
            ValueError: an invalid width, method, dtype or rngs.
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
        self.adapter = nnx.data(None)  # may be set to a variable later
        self.method = method
        self.dtype = dtype
        if method is not None and not method.trains_base:
            params, kernel = method.init(rngs.params(), self.kernel.get_value())
            self.kernel.set_value(kernel)
            self.adapter = AdapterParam(method.trimmed(params))

    def __call__(
        self,
        x: jax.Array,
        *,
        token_mask: Mask = None,
        return_aux: bool = False,
        out_sharding: None = None,
    ) -> Any:
        """y [...tokens, O], or (y, aux) if `return_aux`; see `dense`. out_sharding must be None."""
        if out_sharding is not None:
            reject_out_sharding()
        layer = self.arrays()
        x = cast_input(self.dtype, x, layer.kernel, token_mask, layer.kernel.shape[0])
        y, aux = apply_layer(layer, x, token_mask)
        if return_aux:
            return y, aux
        if self.adapter is not None:
            self.store_aux(aux)
        return y

    def arrays(self) -> DenseLayer:
        """The layer's arguments for `dense` and `dense_shared_input`.

        Raises:
            ValueError: the adapter's parameters, which a caller may replace, do not fit its method.
        """
        kernel, bias = self.kernel.get_value(), None if self.bias is None else self.bias.get_value()
        params = None if self.adapter is None else self.adapter.get_value()
        if params is not None and self.method is not None:
            check_params(self.method, params, kernel.shape)
        return DenseLayer(kernel, bias, params, self.method, self.dropout_key)
