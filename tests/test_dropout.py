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
X = jax.device_put(np.random.default_rng(0).normal(size=(6, 5)).astype("f"))
WITH_DROPOUT = LoRA(rank=2, dropout=RATE)
KINDS = with_random_parameters(nets.Kinds)


equal = np.array_equal
dropped = jax.jit(dropout, static_argnums=1)


def test_dropped_fraction_is_zero_and_the_rest_is_rescaled():
    x = np.asarray(dropped(np.ones((200, 100), jnp.bfloat16), 0.25, KEY))
    assert x.dtype == jnp.bfloat16
    np.testing.assert_allclose(np.unique(x.astype("f")), [0, 4 / 3], rtol=4e-3)
    np.testing.assert_allclose((x == 0).mean(), 0.25, atol=0.01)


@pytest.mark.parametrize(
    "method", [WITH_DROPOUT, DoRA(rank=2, dropout=RATE), AdaLoRA(2, dropout=RATE)]
)
def test_formula_matches_peft(method):
    """PEFT 0.21.2: lora_B(lora_A(dropout(x))); DoRA's magnitude rescales W dropout(x) (dora.py)."""
    kernel = np.random.default_rng(1).normal(size=(5, 4)).astype("f")
    params = with_noise(jax.jit(method.init)(jax.random.key(2), kernel)[0], 0.3)
    x = np.asarray(dropped(X, RATE, KEY))
    a, b = np.asarray(params["lora_a"]), np.asarray(params["lora_b"])
    if isinstance(method, AdaLoRA):
        a = a * np.asarray(params["lora_e"])
    delta = method.scale * x @ a @ b
    if isinstance(method, DoRA):
        adapted = kernel + method.scale * a @ b
        factor = np.asarray(jax.jit(column_factor)(params["magnitude"], adapted))
        delta = (factor - 1) * (x @ kernel) + factor * delta

    @jax.jit
    def run(kernel):
        apply = lambda kernel: method.apply_with_dropout(params, X, kernel, KEY)  # noqa: E731
        return apply(kernel), jax.grad(lambda kernel: apply(kernel)[0].sum())(kernel)

    (y, aux), kernel_gradient = run(kernel)
    np.testing.assert_allclose(y, np.asarray(X) @ kernel + delta, rtol=1e-4, atol=1e-5)
    assert aux.active_rank.shape == X.shape[:-1]
    assert not np.any(kernel_gradient)  # the base is frozen, as without dropout


def trained(base, *rules, **options):
    return nets.trained(*rules, seed=1, net=base, size=0.3, **options)


@pytest.mark.parametrize("path", ["conv", "split", "experts", "join", "blocks", "out"])
def test_every_layer_type(path):
    """Outputs depend on the key in training and are deterministic in evaluation."""
    model = trained(KINDS, (path, WITH_DROPOUT))
    without = nnx.clone(model)
    getattr(without, path).method = LoRA(rank=2)
    ids = np.array([[1, 2, 3], [4, 5, 6]])

    @jax.jit
    def run(model, without, key):
        return lorasp_jax.with_dropout(model, key)(ids), model(ids), without(ids)

    keys = (KEY, jax.random.key(8), KEY)
    (first, off, expected), (second, *_), (again, *_) = (run(model, without, key) for key in keys)
    assert not np.allclose(first, second)
    assert equal(first, again)
    assert equal(off, expected)


def test_embedding_ids_are_never_dropped():
    model, ids = trained(KINDS, ("embed", WITH_DROPOUT)), np.array([[1, 2, 3]])
    both = jax.jit(lambda model: (lorasp_jax.with_dropout(model, KEY)(ids), model(ids)))
    assert equal(*both(model))


def test_layers_experts_and_stacks_use_independent_masks():
    model = lorasp_jax.with_dropout(trained(KINDS, ("out|join|blocks", WITH_DROPOUT)), KEY)
    keys = [model.out.dropout_key, model.join.dropout_key, *model.blocks.dropout_key]
    assert len({tuple(jax.random.key_data(key).tolist()) for key in keys}) == 5
    layer, x = trained(KINDS, ("experts", WITH_DROPOUT)).experts, np.ones((50, 2, 3), "f")
    same = lambda leaf: np.stack([leaf[0]] * 2)  # noqa: E731
    layer.adapter.set_value(jax.tree.map(same, jax.device_get(layer.adapter.get_value())))
    layer.kernel.set_value(same(np.asarray(layer.kernel.get_value())))
    layer.bias.set_value(np.zeros((2, 3), "f"))
    both = jax.jit(lambda layer, x: (lorasp_jax.with_dropout(layer, KEY)(x), layer(x)))
    y, off = map(np.asarray, both(layer, x))
    assert equal(off[:, 0], off[:, 1])
    assert not np.allclose(y[:, 0], y[:, 1])


def test_dropout_is_off_in_derived_models(tmp_path):
    base = with_random_parameters(lambda: nnx.Linear(5, 4, rngs=nnx.Rngs(0)))
    model = trained(base, ("", WITH_DROPOUT))
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

    base = with_random_parameters(lambda: nnx.Linear(5, 4, rngs=nnx.Rngs(0)))
    (expected, without), (evaluation, training) = program(base, 0.0), program(base, RATE)
    assert expected == without == evaluation
    assert "low_rank_matmul" in expected
    assert "random_bits" in training


@pytest.mark.parametrize("scanned", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_models_with_remat_and_scan(scanned):
    """Test the documented loss, which takes a key."""
    base = with_random_parameters(lambda: Llama(remat=True, scanned=scanned))
    model = trained(base, ("layers|head", WITH_DROPOUT), einsums=EINSUMS)
    graphdef, adapters, frozen = lorasp_jax.split(model)

    @jax.jit
    @jax.value_and_grad
    def loss(adapters, key):
        model = nnx.merge(graphdef, adapters, frozen, copy=True)
        return jnp.square(lorasp_jax.with_dropout(model, key)(IDS)).mean()

    value, gradient = loss(adapters, KEY)
    other, _ = loss(adapters, jax.random.key(9))
    assert float(value) != float(other)
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


LINEN_IDS = np.array([[1, 2, 3], [4, 5, 6]])


def random_variables(adapter):
    shapes = jax.eval_shape(adapter.init, jax.random.key(0), LINEN_IDS)
    return with_noise(jax.tree.map(lambda leaf: np.zeros(leaf.shape, "f"), shapes), 0.3)


@pytest.mark.parametrize("path", ["blocks", "split", "conv"])
def test_linen(path):
    adapter = lorasp_jax.LinenAdapter(Linen(), [(path, WITH_DROPOUT)])
    variables = random_variables(adapter)
    off = dataclasses.replace(adapter, rules=[(path, LoRA(rank=2))])

    @jax.jit
    def run(key):
        apply = lambda adapter, **rngs: adapter.apply(variables, LINEN_IDS, **rngs)  # noqa: E731
        with_key = [apply(one, rngs={"dropout": key}) for one in (adapter, off)]
        return *with_key, apply(adapter), apply(off)

    (first, *others), (second, *_) = run(KEY), run(jax.random.key(8))
    assert not np.allclose(first, second)
    assert equal(first, run(KEY)[0])
    without_dropout, without_key, expected = others
    assert equal(without_key, expected)
    assert equal(without_dropout, expected)


def test_linen_scan_without_split_rngs():
    adapter = lorasp_jax.LinenAdapter(Linen(streams=("params",)), [("blocks", WITH_DROPOUT)])
    variables = random_variables(adapter)
    jax.eval_shape(adapter.apply, variables, LINEN_IDS)
    with_key = lambda variables: adapter.apply(variables, LINEN_IDS, rngs={"dropout": KEY})  # noqa: E731
    with pytest.raises(ValueError, match=r"blocks/dense .* split_rngs"):
        jax.eval_shape(with_key, variables)


def test_linen_dense():
    layer = LinenDense(4, method=WITH_DROPOUT)
    variables = layer.init(jax.random.key(0), X)
    variables |= {"adapters": with_noise(variables["adapters"], 0.3)}
    first, second = (layer.apply(variables, X, rngs={"dropout": k}) for k in jax.random.split(KEY))
    assert not np.allclose(first, second)
    expected = LinenDense(4, method=LoRA(rank=2)).apply(variables, X)
    assert equal(layer.apply(variables, X), expected)
