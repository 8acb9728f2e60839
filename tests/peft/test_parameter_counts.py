"""Test the parameter count of an adapted layer against its formula, for every method and preset."""

import jax
import jax.numpy as jnp
import pytest

from lorasp_jax import peft
from lorasp_jax.peft import (
    AdaLoRA,
    DoRA,
    FullFineTuning,
    LoRA,
    LoRAMoE,
    LoRASP,
    LoRASPRelease,
)

I, O = 24, 40
"""d_in, d_out."""

TABLE = [
    # LoRA with each initialization: A and B.
    (LoRA(), 128 * (I + O)),
    (LoRA(rank=7, rank_stabilized=True), 7 * (I + O)),
    *((LoRA(rank=7, initialization=name), 7 * (I + O)) for name in ("gaussian", "pissa", "olora")),
    (LoRA(rank=7, initialization="eva"), 7 * (I + O)),
    # Plus a magnitude per output.
    (DoRA(), 128 * (I + O) + O),
    # Plus a diagonal between A and B.
    (AdaLoRA(), 128 * (I + O) + 128),
    # Four experts of rank 32 and a linear router, weighted or top-1.
    (LoRAMoE(), 4 * 32 * (I + O) + 4 * I),
    (LoRAMoE(routing="top1"), 4 * 32 * (I + O) + 4 * I),
    # Bank of R directions, h hidden units: R (I + O) + h (I + R), plus h + R biases.
    (LoRASP(), 128 * (I + O) + 32 * (I + 128) + 32 + 128),
    *(
        (LoRASP(rank=8, hidden_width=4, router=name), 8 * (I + O) + 4 * (I + 8) + 4 + 8)
        for name in ("gelu", "gelu_relu", "gelu_softmax")
    ),
    (LoRASP.paper(), 128 * (I + O) + 4 * (I + 128)),
    (LoRASPRelease(), 128 * (I + O) + 128 * I),
    (FullFineTuning(), I * O),
]


@pytest.mark.parametrize(("method", "expected"), TABLE, ids=lambda x: str(x)[:60])
def test_parameter_count(method, expected):
    def init(key, kernel):
        return method.init(key, kernel, statistics=jnp.eye(I))[0]

    kernel = jax.ShapeDtypeStruct((I, O), jnp.float32)
    shapes = jax.eval_shape(init, jax.random.key(0), kernel)
    assert sum(leaf.size for leaf in jax.tree.leaves(shapes)) == expected


def test_every_method_and_preset_is_in_the_table():
    assert {method.name for method, _ in TABLE} == set(peft.names())
    presets = {
        getattr(peft.find(name), attribute)()
        for name in peft.names()
        for attribute, value in vars(peft.find(name)).items()
        if isinstance(value, classmethod) and not attribute.startswith("_")
    }
    assert presets == {LoRASP.paper()} <= {method for method, _ in TABLE}
