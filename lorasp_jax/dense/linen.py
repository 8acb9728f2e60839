"""The drop-in for Flax Linen's `nn.Dense`."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.typing import Dtype, Initializer

from lorasp_jax.dense import validate
from lorasp_jax.dense.functional import DenseLayer, apply_layer, cast_input
from lorasp_jax.dense.layers import AUX_NAME, KERNEL_INIT
from lorasp_jax.peft import Method
from lorasp_jax.peft.method import Mask, Params, check_params, dropout_rate


class LinenDense(nn.Module):
    """A dense layer with an optional adapter, a drop-in for `nn.Dense`.

    Kernel and bias are in the collection "params", the adapter's parameters in "adapters". Full
    fine-tuning trains "params" and has no "adapters". If "intermediates" is mutable, aux is sown
    there for `collect_aux`. Passing an rng for "dropout" enables the method's dropout.

    Attributes:
        features: O.
        use_bias: whether to add a bias.
        method: adapter method, or None.
        dtype: compute dtype; None promotes the dtypes of input and kernel.
        param_dtype: dtype of kernel and bias; adapters are always fp32.
        kernel_init: initializer of the kernel.
    """

    features: int
    use_bias: bool = True
    method: Method | None = None
    dtype: Dtype | None = None
    param_dtype: Dtype = jnp.float32
    kernel_init: Initializer = KERNEL_INIT

    @nn.compact
    def __call__(self, x: jax.Array, *, token_mask: Mask = None, return_aux: bool = False) -> Any:
        """y [...tokens, O], or (y, aux) if `return_aux`; see `dense`."""
        validate.method(self.method)
        validate.floating_dtype("param_dtype", self.param_dtype)
        validate.floating_dtype("dtype", self.dtype or self.param_dtype)
        shape = (validate.array(x).shape[-1], validate.size("features", self.features))
        kernel = self.param("kernel", self.kernel_init, shape, self.param_dtype)
        bias = None
        if self.use_bias:
            bias = self.param("bias", nn.initializers.zeros, (self.features,), self.param_dtype)
        params = None
        if self.method is not None and not self.method.trains_base:
            params = self.variable("adapters", "adapter", self._init_adapter, kernel).value
            check_params(self.method, params, shape)
        x = cast_input(self.dtype, x, kernel, token_mask)
        use_dropout = params is not None and dropout_rate(self.method) and self.has_rng("dropout")
        key = self.make_rng("dropout") if use_dropout else None
        y, aux = apply_layer(DenseLayer(kernel, bias, params, self.method, key), x, token_mask)
        if return_aux:
            return y, aux
        if params is not None:
            self.sow("intermediates", AUX_NAME, aux)
        return y

    def _init_adapter(self, kernel: jax.Array) -> Params:
        assert self.method is not None
        if self.method.splits_kernel:
            raise ValueError(
                "this initialization changes the kernel, which Linen does not allow: choose "
                "another one, or use `adapt` on an NNX model"
            )
        return self.method.trimmed(self.method.init(self.make_rng("params"), kernel)[0])
