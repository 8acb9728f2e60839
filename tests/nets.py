"""Small adapted models with non-initial adapter parameters, shared by several tests."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax import peft
from lorasp_jax.adapters import adaptation
from lorasp_jax.dense import Dense
from lorasp_jax.peft import LoRA, LoRASP
from tests import GOLDEN
from tests.adapters.io import peft_folder
from tests.models.random_models import with_noise, with_random_parameters

SP = LoRASP(rank=8, hidden_width=4)
SIZES = {"rank": 8, "hidden_width": 4}


def small(name, sizes=SIZES):
    """Create a method by module name, with small sizes."""
    fields = {field.name for field in dataclasses.fields(peft.find(name))}
    return peft.create(name, **{key: size for key, size in sizes.items() if key in fields})


METHODS = {name: small(name) for name in peft.names()}


class Net(nnx.Module):
    """Two third-party `nnx.Linear` layers around a scanned stack."""

    def __init__(self):
        self.inp = nnx.Linear(5, 4, rngs=nnx.Rngs(0))
        self.blocks = nnx.vmap(lambda r: Dense(4, 4, rngs=r))(nnx.Rngs(1).split(3))
        self.out = nnx.Linear(4, 2, rngs=nnx.Rngs(2))

    def __call__(self, x):
        graphdef, layers = nnx.split(self.blocks)

        def block(x, layer):
            y, _ = nnx.merge(graphdef, layer)(x, return_aux=True)
            return x + jnp.tanh(y), None

        x, _ = jax.lax.scan(jax.checkpoint(block), self.inp(x), layers)
        return self.out(x)


class Kinds(nnx.Module):
    """Every supported layer type; maps ids [B, T] to [B, T, 4]."""

    def __init__(self):
        rngs, init = nnx.Rngs(0), nnx.initializers.normal()
        self.embed = nnx.Embed(7, 6, rngs=rngs)
        self.conv = nnx.Conv(6, 6, (2,), rngs=rngs)
        self.split = nnx.LinearGeneral(6, (2, 3), rngs=rngs, bias_init=init)
        self.experts = nnx.Einsum("...nh,nhk->...nk", (2, 3, 3), (2, 3), rngs=rngs)
        self.join = nnx.LinearGeneral((2, 3), 6, axis=(-2, -1), use_bias=False, rngs=rngs)
        self.blocks = nnx.vmap(lambda r: nnx.Einsum("...d,fd->...f", (6, 6), rngs=r))(rngs.split(3))
        self.out = nnx.Linear(6, 4, rngs=rngs)

    def __call__(self, ids):
        x = self.conv(self.embed(ids))
        x = self.join(jnp.tanh(self.experts(self.split(x))))
        scan = nnx.scan(lambda x, layer: (x + layer(x), None), in_axes=(nnx.Carry, 0))
        return self.out(scan(x, self.blocks)[0])


NET = with_random_parameters(Net)
X = jax.device_put(np.random.default_rng(0).normal(size=(4, 3, 5)).astype("f"))


@jax.jit
def call(model, x):
    return model(x)


def trained(*rules, seed, net=NET, size=0.5, **options):
    """Adapt a model, with random adapters of this size; compiles nothing if it can."""
    adapt = lambda: adaptation.adapt(net, rules, rngs=nnx.Rngs(seed), **options)  # noqa: E731
    if any(method is not None and method.splits_kernel for _, method in rules):
        graphdef, adapters, frozen = adaptation.split(adapt())
        return nnx.merge(graphdef, with_noise(adapters, size, seed), frozen)
    graphdef, adapters, shapes = adaptation.split(nnx.eval_shape(adapt))
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), adapters)
    base = dict(nnx.to_flat_state(nnx.state(net)))
    frozen = [(path, v.replace(base[path].get_value())) for path, v in nnx.to_flat_state(shapes)]
    return nnx.merge(graphdef, with_noise(zeros, size, seed), nnx.from_flat_state(frozen))


def assert_close(actual, expected):
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-5)


def golden_model(golden, base, name, method):
    layers = [n for n in range(3) if f"param/lin.{n}.lora_A.{name}.weight" in golden]
    pattern = "|".join(f"lin/{n}" for n in layers)
    model = trained((pattern, method), seed=0, net=base)
    for n in layers:
        a, b = (golden[f"param/lin.{n}.lora_{side}.{name}.weight"].T for side in "AB")
        model.lin[n].adapter.set_value(jax.device_put({"lora_a": a, "lora_b": b}))
    return model


def golden_models():
    """Return the golden file lora_multi.npz, and PEFT's adapters on one base by name."""
    with np.load(GOLDEN / "lora_multi.npz") as file:
        golden = dict(file)
    methods = {
        "a": LoRA(rank=4, alpha=10),
        "b": LoRA(rank=6, alpha=5, rank_stabilized=True),
        "c": LoRA(rank=6, alpha=5),
    }
    base = peft_folder.reference_net(golden)
    return golden, {name: golden_model(golden, base, name, m) for name, m in methods.items()}
