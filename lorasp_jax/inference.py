"""Adapters made ready for inference: what does not depend on the input is computed once.

A layer that is called again and again on a few tokens, as in the steps of a flow, should not join,
normalise and convert its adapter's matrices each time.
"""

from flax import nnx

from lorasp_jax.adaptation import Model, over_stack
from lorasp_jax.dense import Dense, with_value
from lorasp_jax.kernels.low_rank_matmul import Prepared
from lorasp_jax.peft import Method
from lorasp_jax.peft.method import Params


def prepared(model: Model) -> Model:
    """A copy whose adapters have P and U at hand, in the type of their layer's computation.

    It computes the same; it is not meant to be trained or saved. Layers of the kind `Dense` with a
    type of their own are prepared, if their method is x W + z U.
    """
    model = nnx.merge(*nnx.split(model))
    for _, layer in nnx.iter_modules(model):
        if type(layer) is Dense and layer.adapter is not None and layer.dtype is not None:
            method, params = layer.carried()
            if type(method).apply is Method.apply and not isinstance(params, Prepared):
                _prepare(layer, method)
    return model


def _prepare(layer: Dense, method: Method) -> None:
    def one(params: Params) -> Prepared:
        down, up = (
            matrix.astype(layer.dtype) for matrix in (method.down(params), method.up(params))
        )
        return Prepared(params, down, up)

    assert layer.adapter is not None
    ready = over_stack(one, layer.kernel_matrices())(layer.adapter.get_value())
    layer.adapter = with_value(layer.adapter, ready)  # the old variable is the given model's too
