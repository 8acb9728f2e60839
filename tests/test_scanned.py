"""Test the documented training loop on models that use nnx.remat and nnx.scan internally, like NNX
language models (tunix's Llama: custom einsum layers, remat around methods)."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters.io.native import load_adapters, save_adapters
from lorasp_jax.peft import LoRASP

WIDTH, HEADS, DEPTH, VOCABULARY = 4, 2, 3, 7
SP = LoRASP(rank=4, hidden_width=2)


class Einsum(nnx.Module):
    """A custom einsum layer class."""

    def __init__(self, einsum_str, shape, *, rngs):
        self.einsum_str, self.shape = einsum_str, shape
        self.w = nnx.Param(nnx.initializers.normal(0.5)(rngs.params(), shape))

    def __call__(self, x):
        return jnp.einsum(self.einsum_str, x, self.w[...])


class Layer(nnx.Module):
    """Attention without softmax and an MLP, optionally rematerialized."""

    def __init__(self, remat, *, rngs):
        self.norm = nnx.RMSNorm(WIDTH, rngs=rngs)
        self.q = Einsum("BTD,NDH->BTNH", (HEADS, WIDTH, 2), rngs=rngs)
        self.o = Einsum("BTNH,NHD->BTD", (HEADS, 2, WIDTH), rngs=rngs)
        self.mlp = nnx.Linear(WIDTH, WIDTH, use_bias=False, rngs=rngs)
        self.remat = remat

    def block(self, x):
        x = x + self.o(jnp.tanh(self.q(self.norm(x))))
        return x + nnx.silu(self.mlp(x))

    def __call__(self, x):
        return nnx.remat(self.block.__func__)(self, x) if self.remat else self.block(x)


class Llama(nnx.Module):
    """Map token ids [B, T] to logits; `scanned` stacks the layers."""

    def __init__(self, *, remat, scanned):
        rngs = nnx.Rngs(0)
        self.embedder = nnx.Embed(VOCABULARY, WIDTH, rngs=rngs)
        if scanned:
            self.layers = nnx.vmap(lambda r: Layer(remat, rngs=r))(rngs.split(DEPTH))
        else:
            self.layers = nnx.List([Layer(remat, rngs=rngs) for _ in range(DEPTH)])
        self.head = nnx.Linear(WIDTH, VOCABULARY, rngs=rngs)

    def __call__(self, ids):
        x = self.embedder(ids)
        if isinstance(self.layers, nnx.List):
            for layer in self.layers:
                x = layer(x)
        else:
            run = nnx.scan(lambda x, layer: layer(x), in_axes=(nnx.Carry, 0), out_axes=nnx.Carry)
            x = run(x, self.layers)
        return self.head(x)


IDS = jnp.array([[1, 2, 3, 4], [5, 5, 2, 0]])
EINSUMS = {Einsum: lambda layer: ("w", layer.einsum_str)}


def adapted(base):
    rules = [("layers|head", SP)]
    return lorasp_jax.adapt(base, rules, rngs=nnx.Rngs(1), einsums=EINSUMS)


def loss_of(model):
    """Return the documented loss of a model, and its adapters."""
    graphdef, adapters, frozen = lorasp_jax.split(model)

    def loss(adapters):
        model = nnx.merge(graphdef, adapters, frozen, copy=True)
        logits = model(IDS)
        losses = lorasp_jax.auxiliary_losses(lorasp_jax.collect_aux(model))
        task = optax.softmax_cross_entropy_with_integer_labels(logits, IDS).mean()
        return task + sum(losses.values()), losses

    return loss, adapters


@pytest.mark.parametrize(
    ("remat", "scanned"),
    [(True, True), pytest.param(True, False, marks=pytest.mark.slow)],
    ids=["remat and scan", "remat"],
)
def test_documented_training_loop(remat, scanned, tmp_path):
    base = Llama(remat=remat, scanned=scanned)
    model = adapted(base)
    loss, adapters = loss_of(model)
    optimizer = optax.adam(3e-2)

    @jax.jit
    def step(adapters, state):
        (value, losses), gradient = jax.value_and_grad(loss, has_aux=True)(adapters)
        updates, state = optimizer.update(gradient, state)
        return optax.apply_updates(adapters, updates), state, value, losses

    state, history = optimizer.init(adapters), []
    for _ in range(5):
        adapters, state, value, losses = step(adapters, state)
        history.append(float(value))
    assert history[-1] < history[0]
    assert {name: loss.shape for name, loss in losses.items()} == dict.fromkeys(
        ("balance", "spectral", "z"), ()
    )
    graphdef, _, frozen = lorasp_jax.split(model)
    save_adapters(tmp_path, nnx.merge(graphdef, adapters, frozen, copy=True))
    _, loaded, _ = lorasp_jax.split(load_adapters(tmp_path, base, einsums=EINSUMS))
    jax.tree.map(np.testing.assert_array_equal, loaded, adapters)
    with pytest.raises(ValueError, match=r"unsupported classes: .*layers(/0)?/[qo] \(Einsum\)"):
        load_adapters(tmp_path, base)


@pytest.mark.slow
def test_remat_and_scan_do_not_change_results():
    """Loss and gradients of the stack equal those of separate layers."""
    model = adapted(Llama(remat=True, scanned=True))
    separate_layers = adapted(Llama(remat=False, scanned=False))
    for name in ("embedder", "head"):
        setattr(separate_layers, name, getattr(model, name))
    _, stack = nnx.split(model.layers)
    for i in range(DEPTH):
        nnx.update(separate_layers.layers[i], jax.tree.map(lambda leaf, i=i: leaf[i], stack))
    values, gradients = zip(
        *(value_and_gradient(*loss_of(m)) for m in (model, separate_layers)), strict=True
    )
    np.testing.assert_allclose(values[0], values[1], rtol=1e-5)
    stacked, separate = (dict(nnx.to_flat_state(g)) for g in gradients)
    for path, variable in stacked.items():
        if path[0] == "layers":
            by_layer = [separate[("layers", i, *path[1:])].get_value() for i in range(DEPTH)]
            jax.tree.map(
                lambda a, *b: np.testing.assert_allclose(a, jnp.stack(b), rtol=1e-3, atol=1e-6),
                variable.get_value(),
                *by_layer,
            )


def value_and_gradient(loss, adapters):
    (value, _), gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))(adapters)
    return value, gradient
