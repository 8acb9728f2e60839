"""Test dropout on adapter inputs: PEFT's formula, off in evaluation, for every layer type."""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters.io.native import load_adapters, save_adapters
from lorasp_jax.dense import LinenDense
from lorasp_jax.peft import AdaLoRA, DoRA, LoRA
from lorasp_jax.peft.dora import column_factor
from lorasp_jax.peft.method import dropout
from tests import nets
from tests.models.random_models import with_noise, with_random_parameters
from tests.test_scanned import EINSUMS, IDS, Llama

RATE = 0.4
KEY = jax.random.key(7)
X = jax.random.normal(jax.random.key(0), (6, 5))
WITH_DROPOUT = LoRA(rank=2, dropout=RATE)
KINDS = with_random_parameters(nets.Kinds)


def equal(a, b):
    return bool(jnp.array_equal(a, b))


def test_dropped_fraction_is_zero_and_the_rest_is_rescaled():
    dropped = dropout(jnp.ones((200, 100), jnp.bfloat16), 0.25, KEY)
    assert dropped.dtype == jnp.bfloat16
    np.testing.assert_allclose(jnp.unique(dropped), [0, 4 / 3], rtol=4e-3)
    np.testing.assert_allclose((dropped == 0).mean(), 0.25, atol=0.01)


@pytest.mark.parametrize(
    "method", [WITH_DROPOUT, DoRA(rank=2, dropout=RATE), AdaLoRA(2, dropout=RATE)]
)
def test_formula_matches_peft(method):
    """PEFT 0.21.2: lora_B(lora_A(dropout(x))); DoRA's magnitude rescales W dropout(x) (dora.py)."""
    kernel = jax.random.normal(jax.random.key(1), (5, 4))
    params = with_noise(method.init(jax.random.key(2), kernel)[0], 0.3)
    dropped = dropout(X, RATE, KEY)
    a, b = params["lora_a"], params["lora_b"]
    if isinstance(method, AdaLoRA):
        a = a * params["lora_e"]
    delta = method.scale * dropped @ a @ b
    if isinstance(method, DoRA):
        factor = column_factor(params["magnitude"], kernel + method.scale * a @ b)
        delta = (factor - 1) * (dropped @ kernel) + factor * delta
    y, aux = method.apply_with_dropout(params, X, kernel, KEY)
    np.testing.assert_allclose(y, X @ kernel + delta, rtol=1e-4, atol=1e-5)
    assert aux.active_rank.shape == X.shape[:-1]
    kernel_gradient = jax.grad(
        lambda kernel: method.apply_with_dropout(params, X, kernel, KEY)[0].sum()
    )(kernel)
    assert not kernel_gradient.any()  # the base is frozen, as without dropout


def trained(base, rules, **options):
    model = lorasp_jax.adapt(base, rules, rngs=nnx.Rngs(1), **options)
    graphdef, adapters, frozen = lorasp_jax.split(model)
    return nnx.merge(graphdef, with_noise(adapters, 0.3), frozen, copy=True)


@pytest.mark.parametrize("path", ["conv", "split", "experts", "join", "blocks", "out"])
def test_every_layer_type(path):
    """Outputs depend on the key in training and are deterministic in evaluation."""
    model = trained(KINDS, [(path, WITH_DROPOUT)])
    ids = jnp.array([[1, 2, 3], [4, 5, 6]])

    @jax.jit
    def run(key):
        return lorasp_jax.with_dropout(model, key)(ids)

    first, second = run(KEY), run(jax.random.key(8))
    assert not np.allclose(first, second)
    assert equal(first, run(KEY))
    without = nnx.clone(model)
    getattr(without, path).method = LoRA(rank=2)
    assert equal(nets.call(model, ids), nets.call(without, ids))


def test_embedding_ids_are_never_dropped():
    model = trained(KINDS, [("embed", WITH_DROPOUT)])
    ids = jnp.array([[1, 2, 3]])
    assert equal(nets.call(lorasp_jax.with_dropout(model, KEY), ids), nets.call(model, ids))


def test_layers_experts_and_stacks_use_independent_masks():
    model = lorasp_jax.with_dropout(trained(KINDS, [("out|join|blocks", WITH_DROPOUT)]), KEY)
    keys = [model.out.dropout_key, model.join.dropout_key, *model.blocks.dropout_key]
    assert len({tuple(jax.random.key_data(key).tolist()) for key in keys}) == 5
    layer = trained(KINDS, [("experts", WITH_DROPOUT)]).experts
    x = jnp.ones((50, 2, 3))
    equal_experts = jax.tree.map(lambda p: p.at[1].set(p[0]), layer.adapter.get_value())
    layer.adapter.set_value(equal_experts)
    layer.kernel.set_value(layer.kernel.get_value().at[1].set(layer.kernel.get_value()[0]))
    layer.bias.set_value(jnp.zeros_like(layer.bias.get_value()))
    y = lorasp_jax.with_dropout(layer, KEY)(x)
    assert equal(layer(x)[:, 0], layer(x)[:, 1])
    assert not np.allclose(y[:, 0], y[:, 1])


def test_dropout_is_off_in_derived_models(tmp_path):
    base = nnx.Linear(5, 4, rngs=nnx.Rngs(0))
    model = trained(base, [("", WITH_DROPOUT)])
    training_model = lorasp_jax.with_dropout(model, KEY)
    assert not np.allclose(training_model(X), model(X))
    restored = nnx.merge(*lorasp_jax.split(training_model))
    assert lorasp_jax.split(training_model)[0] == lorasp_jax.split(model)[0]
    assert equal(restored(X), model(X))
    np.testing.assert_allclose(lorasp_jax.merge(training_model)(X), model(X), atol=1e-5)
    save_adapters(tmp_path / "a", training_model)
    loaded = load_adapters(tmp_path / "a", base)
    assert loaded.method == WITH_DROPOUT
    assert equal(loaded(X), model(X))


def test_program_without_dropout_is_unchanged():
    """Covers methods without dropout in training, and methods with dropout in evaluation."""

    def program(model, rate):
        model = lorasp_jax.adapt(model, [("", LoRA(rank=2, dropout=rate))], rngs=nnx.Rngs(1))
        graphdef, adapters, frozen = lorasp_jax.split(model)

        def loss(adapters, x, training):
            model = nnx.merge(graphdef, adapters, frozen, copy=True)
            return (lorasp_jax.with_dropout(model, KEY) if training else model)(x).sum()

        def text(training):
            return str(jax.make_jaxpr(jax.grad(lambda a, x: loss(a, x, training)))(adapters, X))

        return text(False), text(True)

    base = nnx.Linear(5, 4, rngs=nnx.Rngs(0))
    (expected, without), (evaluation, training) = program(base, 0.0), program(base, RATE)
    assert expected == without == evaluation
    assert "low_rank_matmul" in expected
    assert "random_bits" in training


@pytest.mark.parametrize("scanned", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_models_with_remat_and_scan(scanned):
    """Test the documented loss, which takes a key."""
    rules = [("layers|head", WITH_DROPOUT)]
    model = trained(Llama(remat=True, scanned=scanned), rules, einsums=EINSUMS)
    graphdef, adapters, frozen = lorasp_jax.split(model)

    @jax.jit
    def loss(adapters, key):
        model = nnx.merge(graphdef, adapters, frozen, copy=True)
        return jnp.square(lorasp_jax.with_dropout(model, key)(IDS)).mean()

    value, gradient = jax.value_and_grad(loss)(adapters, KEY)
    other, _ = jax.value_and_grad(loss)(adapters, jax.random.key(9))
    assert value != other
    assert all(np.abs(g).max() > 0 for g in jax.tree.leaves(gradient))


class Block(nn.Module):
    @nn.compact
    def __call__(self, x, _=None):
        return x + jnp.tanh(nn.Dense(6, name="dense")(x)), None


class Linen(nn.Module):
    """A scanned stack, an einsum, a convolution and an embedding."""

    streams: tuple = ("params", "dropout")

    @nn.compact
    def __call__(self, ids):
        x = nn.Embed(7, 6, name="embed")(ids)
        scan = nn.scan(Block, {"params": 0}, split_rngs=dict.fromkeys(self.streams, True), length=2)
        x, _ = scan(name="blocks")(x, None)
        x = nn.DenseGeneral((2, 3), name="split")(x).reshape(x.shape)
        return nn.Conv(4, (2,), name="conv")(x)


LINEN_IDS = jnp.array([[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize("path", ["blocks", "split", "conv"])
def test_linen(path):
    adapter = lorasp_jax.LinenAdapter(Linen(), [(path, WITH_DROPOUT)])
    variables = jax.jit(adapter.init)(jax.random.key(0), LINEN_IDS)
    variables |= {"adapters": with_noise(variables["adapters"], 0.3)}
    run = jax.jit(lambda key: adapter.apply(variables, LINEN_IDS, rngs={"dropout": key}))
    assert not np.allclose(run(KEY), run(jax.random.key(8)))
    assert equal(run(KEY), run(KEY))
    off = dataclasses.replace(adapter, rules=[(path, LoRA(rank=2))])
    expected = jax.jit(off.apply)(variables, LINEN_IDS)
    assert equal(jax.jit(adapter.apply)(variables, LINEN_IDS), expected)
    without = jax.jit(lambda v: off.apply(v, LINEN_IDS, rngs={"dropout": KEY}))
    assert equal(without(variables), expected)


def test_linen_scan_without_split_rngs():
    adapter = lorasp_jax.LinenAdapter(Linen(streams=("params",)), [("blocks", WITH_DROPOUT)])
    variables = jax.jit(adapter.init)(jax.random.key(0), LINEN_IDS)
    jax.eval_shape(adapter.apply, variables, LINEN_IDS)
    with pytest.raises(ValueError, match=r"blocks/dense .* split_rngs"):
        adapter.apply(variables, LINEN_IDS, rngs={"dropout": KEY})


def test_linen_dense():
    layer = LinenDense(4, method=WITH_DROPOUT)
    variables = layer.init(jax.random.key(0), X)
    variables |= {"adapters": with_noise(variables["adapters"], 0.3)}
    first, second = (layer.apply(variables, X, rngs={"dropout": k}) for k in jax.random.split(KEY))
    assert not np.allclose(first, second)
    expected = LinenDense(4, method=LoRA(rank=2)).apply(variables, X)
    assert equal(layer.apply(variables, X), expected)
