"""Models with LoRA-SP adapters and a calibration set, for tests of pruning and distillation."""

import jax
from flax import nnx

from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.dense import AdapterParam, Dense
from lorasp_jax.peft import LoRASP, LoRASPRelease
from tests.adapters.test_adaptation import Net

RANK = 12
TOKENS = 40
VARIANTS = [
    LoRASP(rank=RANK, hidden_width=4, energy_target=0.6),
    LoRASP(rank=4, hidden_width=2, energy_target=0.6, router="softmax"),
    LoRASPRelease(rank=RANK, energy_target=0.5),
]
IDS = ["default", "softmax", "release"]


def perturbed(model, seed=0, size=1.0):
    """Add noise to all adapters, so that scores differ; `size` scales their deltas."""
    for i, location in enumerate(paths.locate(nnx.List([model]), Dense)):
        if location.child.adapter is not None:
            leaves, structure = jax.tree.flatten(location.child.adapter.get_value())
            keys = jax.random.split(jax.random.key(seed + i), len(leaves))
            noisy = [p + jax.random.normal(k, p.shape) for k, p in zip(keys, leaves, strict=True)]
            params = jax.tree.unflatten(structure, noisy)
            params["bank"]["u"] *= size
            location.child.adapter = AdapterParam(params)
    return model


def lora_sp_model(method, seed=0):
    """Adapt a net with deltas about as large as the base outputs.

    With far larger ones, three blocks and heads would amplify rounding errors of the first block a
    thousandfold.
    """
    net = Net(nnx.Rngs(0))
    model = adaptation.adapt(net, [("blocks|heads", method)], rngs=nnx.Rngs(1))
    return perturbed(model, seed, size=0.1)


def forward(model, batch):
    y, aux = model(batch)
    return y, aux  # the stack's aux; the heads store theirs


@jax.jit
def call(model, x):
    return model(x)[0]
