"""Adapted dense layers: a functional core and its Flax NNX and Linen wrappers.

`dense` works on arrays. `Dense` (Flax NNX) and `LinenDense` (Flax Linen) are drop-ins for
`nnx.Linear` and `nn.Dense`.

As a drop-in, `layer(x)` returns `y` alone and stores its aux for `collect_aux`. An NNX layer can
store aux only while it is mutable. Inside a jitted function, it is mutable if the function takes
the model as an argument or rebuilds it with `nnx.merge`:

    def loss(adapters):
        model = nnx.merge(graphdef, adapters, frozen, copy=True)
        y = model(x)
        aux = lorasp_jax.collect_aux(model)

A model that a jitted function captures in its closure stores no aux. `layer(x, return_aux=True)`
always returns (y, aux) and stores nothing.
"""

from lorasp_jax.dense.functional import (
    DenseLayer,
    apply_layer,
    cast_input,
    dense,
    dense_shared_input,
)
from lorasp_jax.dense.layers import (
    AUX_NAME,
    AdaptedLayer,
    AdapterAux,
    AdapterParam,
    Dense,
    DropoutKey,
    reject_out_sharding,
    with_value,
)
from lorasp_jax.dense.linen import LinenDense

__all__ = [
    "AUX_NAME",
    "AdaptedLayer",
    "AdapterAux",
    "AdapterParam",
    "Dense",
    "DenseLayer",
    "DropoutKey",
    "LinenDense",
    "apply_layer",
    "cast_input",
    "dense",
    "dense_shared_input",
    "reject_out_sharding",
    "with_value",
]
