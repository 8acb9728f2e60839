"""A folder written by Hugging Face PEFT, models that fit it, and edits of its files."""

import itertools
import json

import jax
import jax.numpy as jnp
import safetensors.numpy
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import hugging_face
from lorasp_jax.dense import Dense
from tests import GOLDEN
from tests.models.random_models import with_noise

FOLDER = GOLDEN / "adapter_lora"
SIZES = (24, 40, 24, 16)


class Net(nnx.Module):
    """The reference net that PEFT adapted, randomly initialized; `reference_net` has its arrays."""

    def __init__(self):
        self.lin = nnx.List(
            [
                nnx.Linear(i, o, rngs=nnx.Rngs(n))
                for n, (i, o) in enumerate(itertools.pairwise(SIZES))
            ]
        )

    def __call__(self, x):
        for n, layer in enumerate(self.lin):
            x = layer(x)
            x = jnp.tanh(x) if n < 2 else x
        return x


def reference_net(arrays):
    model = nnx.eval_shape(Net)
    for n, layer in enumerate(model.lin):
        layer.kernel.set_value(jax.device_put(arrays[f"base/lin.{n}.weight"].T))
        layer.bias.set_value(jax.device_put(arrays[f"base/lin.{n}.bias"]))
    return model


class Stack(nnx.Module):
    """Three layers stacked in one kernel."""

    def __init__(self):
        self.layer = Dense(6, 5, rngs=nnx.Rngs(0))
        self.layer.kernel = nnx.Param(jax.random.normal(jax.random.key(0), (3, 6, 5)))


def trained(model, seed=5):
    """Add noise to the adapters, so that none is zero."""
    graphdef, adapters, frozen = adaptation.split(model)
    return nnx.merge(graphdef, with_noise(adapters, 0.3, seed), frozen)


def adapted(*rules, seed=5):
    return trained(adaptation.adapt(Net(), rules, rngs=nnx.Rngs(1)), seed)


def edit_config(folder, **changes):
    """Change fields of the folder's config."""
    config = json.loads((folder / hugging_face.CONFIG).read_text()) | changes
    (folder / hugging_face.CONFIG).write_text(json.dumps(config))


def edit_tensors(folder, change):
    """Apply a function to the folder's tensors."""
    tensors = safetensors.numpy.load_file(folder / hugging_face.TENSORS)
    safetensors.numpy.save_file(change(tensors), folder / hugging_face.TENSORS)
