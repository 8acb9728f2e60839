"""The integration point: one functional adapted dense layer and its two shells.

`dense` works on arrays. `Dense` (Flax NNX) and `LinenDense` (Flax Linen) are drop-ins for
`nnx.Linear` and `nn.Dense`. All reach the same `Method.apply`, the only place that adds a delta.

Called as a drop-in, where `layer(x)` gives `y` alone, a layer keeps what it would report for
`collect_aux`. With NNX that works wherever the module may be changed: eagerly, or inside a jitted
function that gets the model as an argument or merges it itself,

    def loss(adapters):
        model = nnx.merge(graphdef, adapters, frozen, copy=True)
        y = model(x)
        aux = lorasp_jax.collect_aux(model)

A model that `jax.jit` closes over can be called too, but keeps nothing. Code that can handle a
second result asks for it, `layer(x, return_aux=True)`, and then nothing is stored.
"""

from lorasp_jax.dense.functional import DenseLayer, cast_input, dense, dense_shared_input
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
    "cast_input",
    "dense",
    "dense_shared_input",
    "reject_out_sharding",
    "with_value",
]
