"""Test adapter tools on every layer type: general, einsum, scanned, embedding, convolution.

Dense layers have their own tests; here einsums must match equivalent dense layers.
"""

import operator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.compress import calibration
from lorasp_jax.adapters.io import native
from lorasp_jax.dense import AdapterParam, Dense
from lorasp_jax.peft import DoRA, LoRA, LoRASP
from tests.models.random_models import with_random_parameters
from tests.nets import Kinds, assert_close, call, trained

SP = LoRASP(rank=6, hidden_width=4, energy_target=0.6)
WEIGHTS = {"a": 0.6, "b": -0.3}


NET = with_random_parameters(Kinds)
KINDS = ["blocks", "conv", "embed", "experts", "join", "out", "split"]
EINSUMS = ["blocks", "experts", "join", "split"]
IDS = jax.device_put(list(np.random.default_rng(0).integers(0, 7, (3, 4, 5), dtype="i4")))
merge, unmerge = jax.jit(lorasp_jax.merge), jax.jit(lorasp_jax.unmerge)


def combine(models):
    return jax.jit(lambda: lorasp_jax.combine(models))()


def kernels(model):
    """Return the kernels as arrays, by path."""
    layers = {path: getattr(model, path) for path in KINDS}
    return {
        p: np.asarray(v.embedding[...] if p == "embed" else v.kernel[...])
        for p, v in layers.items()
    }


@pytest.fixture(scope="module")
def models():
    """Return two models on the same base whose LoRAs differ in rank, scale and layers."""
    return {
        "a": trained((".*", LoRA(rank=2)), seed=1, net=NET),
        "b": trained(("embed|conv|experts|blocks", LoRA(rank=3, alpha=1)), seed=2, net=NET),
    }


@pytest.fixture(scope="module")
def combined(models):
    return combine(models)


def experts_and_dense_layers(method):
    """Return an einsum with two experts, and the equivalent dense layers."""
    init = nnx.initializers.normal(0.5)
    layer = nnx.Einsum("nbh,nhk->bnk", (2, 5, 4), rngs=nnx.Rngs(0), kernel_init=init)
    layer = trained((".*", method), seed=3, net=layer)
    dense_layers = [Dense(5, 4, use_bias=False, method=method, rngs=nnx.Rngs(0)) for _ in range(2)]
    params = layer.adapter.get_value()
    for i, dense_layer in enumerate(dense_layers):
        dense_layer.kernel.set_value(layer.kernel[...][i])
        dense_layer.adapter = AdapterParam(jax.tree.map(operator.itemgetter(i), params))
    return layer, nnx.List(dense_layers)


def apply_dense_layers(dense_layers, x):
    return jnp.stack([layer(inputs) for layer, inputs in zip(dense_layers, x, strict=True)], axis=1)


def test_moments_equal_a_direct_computation():
    moments = calibration.input_moments(NET, IDS)
    assert sorted(moments) == ["blocks", "experts", "join", "out", "split"]

    @jax.jit
    def inputs(ids):
        x = NET.conv(NET.embed(ids))
        heads = NET.split(x)
        return x, heads, jnp.tanh(NET.experts(heads))

    x, heads, mixed = map(np.asarray, inputs(np.concatenate(IDS)))
    inputs_by_path = {"split": x, "join": mixed.reshape(*mixed.shape[:2], 6)}
    for path, inputs in inputs_by_path.items():
        rows = np.asarray(inputs, np.float64).reshape(-1, 6)
        np.testing.assert_allclose(moments[path], rows.T @ rows, rtol=1e-4, atol=1e-4)
    by_expert = np.einsum("btni,btnj->nij", heads, heads)
    np.testing.assert_allclose(moments["experts"], by_expert, rtol=1e-4, atol=1e-4)
    assert moments["blocks"].shape == (3, 6, 6)
    rules = [("experts|blocks", LoRA(rank=2, initialization="eva"))]
    adapt = lambda: lorasp_jax.adapt(NET, rules, rngs=nnx.Rngs(0), statistics=moments)  # noqa: E731
    a = np.asarray(jax.jit(adapt)().experts.adapter.get_value()["lora_a"])[1]
    right = np.linalg.svd(heads[:, :, 1].reshape(-1, 3), full_matrices=False)[2][:2]
    np.testing.assert_allclose(np.abs(right @ a), np.eye(2), atol=1e-3)


def test_moments_of_embeddings_raise():
    with pytest.raises(ValueError, match="'embed'"):
        calibration.input_moments(NET, IDS, "embed")


@pytest.mark.slow
@pytest.mark.parametrize("tool", [lorasp_jax.prune, lorasp_jax.distill])
def test_experts_shrink_like_equivalent_dense_layers(tool):
    layer, dense_layers = experts_and_dense_layers(SP)
    x = jax.random.normal(jax.random.key(0), (2, 40, 5))
    assert_close(layer(x), apply_dense_layers(dense_layers, x))
    amount = 0.3 if tool is lorasp_jax.prune else 2
    smaller, report = tool(layer, [x], amount)
    expected, each = tool(dense_layers, [x], amount, forward=apply_dense_layers)
    np.testing.assert_array_equal(report.ranks[""], [each.ranks[str(i)] for i in range(2)])
    if tool is lorasp_jax.prune:  # a stack has a single rank, the largest
        assert smaller.method.rank == max(report.ranks[""]) < SP.rank
    else:
        assert_close(call(smaller, x), apply_dense_layers(expected, x))
    error = np.linalg.norm(smaller(x) - layer(x)) / np.linalg.norm(layer(x))
    np.testing.assert_allclose(report.output_error, error, rtol=1e-4)


@pytest.mark.slow
def test_distilled_layers_merge_save_and_load(tmp_path):
    model = trained(("split|experts|join|blocks", SP), seed=4, net=NET, size=0.2)
    smaller, report = lorasp_jax.distill(model, IDS)
    assert sorted(report.ranks) == EINSUMS
    assert {path: ranks.shape for path, ranks in report.ranks.items()} == {
        "blocks": (3,), "experts": (2,), "join": (), "split": ()
    }  # fmt: skip
    assert set(map(type, adaptation.methods(smaller).values())) == {LoRA}
    assert_close(call(lorasp_jax.merge(smaller), IDS[0]), call(smaller, IDS[0]))
    assert 0 < report.output_error < 1
    native.save_adapters(tmp_path, smaller)
    loaded = native.load_adapters(tmp_path, NET)
    np.testing.assert_array_equal(call(loaded, IDS[0]), call(smaller, IDS[0]))


@pytest.mark.slow
def test_pruned_layers_give_the_same_outputs():
    """η = 0.6 never needs all directions, so pruning drops some, but none that was used."""
    model = trained(("split|experts|join|blocks", SP), seed=4, net=NET, size=0.2)
    smaller, report = lorasp_jax.prune(model, IDS)
    assert report.output_error < 1e-5
    for path, ranks in report.ranks.items():
        assert getattr(smaller, path).method.rank == ranks.max()
    assert sum(ranks.sum() for ranks in report.ranks.values()) < 6 * 7
    assert_close(call(smaller, IDS[0]), call(model, IDS[0]))


def test_each_name_gives_the_outputs_of_its_model(models, combined):
    for name, model in models.items():
        assert_close(call(lorasp_jax.choose(combined, name), IDS[0]), call(model, IDS[0]))
        alone = lorasp_jax.extract(combined, name)
        assert adaptation.methods(alone).keys() == adaptation.methods(model).keys()
        np.testing.assert_array_equal(call(alone, IDS[0]), call(model, IDS[0]))
    assert type(lorasp_jax.extract(combined, None).experts) is nnx.Einsum
    assert_close(call(lorasp_jax.choose(combined, None), IDS[0]), call(NET, IDS[0]))


def test_adapters_per_example(models, combined):
    y = np.asarray(call(lorasp_jax.choose(combined, ["b", None, "a", "b"]), IDS[0]))
    expected = [(models["b"], 0), (NET, 1), (models["a"], 2), (models["b"], 3)]
    for model, row in expected:
        assert_close(y[row], np.asarray(call(model, IDS[0]))[row])


def test_attend_of_an_embedding_with_two_adapters(models, combined):
    query = np.random.default_rng(0).normal(size=(4, 6)).astype("f")
    run = jax.jit(lambda embed: embed.attend(query))
    choices = ("a", "b", None, WEIGHTS)
    *attend, both = [np.asarray(run(lorasp_jax.choose(combined, c).embed)) for c in choices]
    for actual, model in zip(attend, [*models.values(), NET], strict=True):
        assert_close(actual, run(model.embed))
    assert_close(both, attend[2] + 0.6 * (attend[0] - attend[2]) - 0.3 * (attend[1] - attend[2]))


def test_weighted_sums_match_merged_kernels(models, combined):
    chosen = lorasp_jax.choose(combined, WEIGHTS)
    fused, errors = lorasp_jax.fuse(combined, WEIGHTS)
    base, merged = kernels(NET), kernels(merge(chosen))
    each = {name: kernels(merge(model)) for name, model in models.items()}
    for path, kernel in kernels(merge(fused)).items():
        sums = base[path] + sum(w * (each[name][path] - base[path]) for name, w in WEIGHTS.items())
        assert_close(merged[path], sums)
        assert_close(kernel, sums)
    assert errors == dict.fromkeys(KINDS, 0.0)
    assert_close(call(fused, IDS[0]), call(chosen, IDS[0]))
    methods = {"a": LoRA(rank=2), "b": LoRA(rank=3, alpha=1)}
    few = {n: trained(("experts|blocks", m), seed=3, net=NET) for n, m in methods.items()}
    smaller, errors = lorasp_jax.fuse(combine(few), WEIGHTS, rank=3)
    assert smaller.experts.adapter.get_value()["lora_a"].shape == (2, 3, 3)
    assert 0 < errors["blocks"] < 1


@pytest.mark.slow
def test_named_adapters_of_other_methods(models):
    others = {
        "sp": trained(("split|experts|blocks", SP), seed=5, net=NET),
        "dora": trained(("split|experts|blocks", DoRA(rank=2)), seed=6, net=NET),
    }
    model = lorasp_jax.combine(models | others)
    for name, expected in others.items():
        assert_close(call(lorasp_jax.choose(model, name), IDS[0]), call(expected, IDS[0]))


def test_unmerging_restores_the_kernels(models):
    unmerged = unmerge(merge(models["a"]), models["a"])
    assert adaptation.methods(unmerged) == adaptation.methods(models["a"])
    for path, kernel in kernels(unmerged).items():
        np.testing.assert_allclose(kernel, kernels(NET)[path], rtol=1e-5, atol=1e-5)
    assert_close(call(unmerged, IDS[0]), call(models["a"], IDS[0]))


def test_unmerging_requires_the_same_layer_types(models):
    merged = merge(models["a"])
    merged.split = with_random_parameters(lambda: nnx.Linear(6, 6, rngs=nnx.Rngs(0)))
    message = "cannot unmerge split: the layer must be of class LinearGeneral, got Linear"
    with pytest.raises(ValueError, match=message):
        unmerge(merged, models["a"])


class Shared(nnx.Module):
    """One layer used under two names."""

    def __init__(self):
        self.first = nnx.Einsum("...d,df->...f", (4, 4), rngs=nnx.Rngs(0))
        self.second = self.first

    def __call__(self, x):
        return self.second(self.first(x))


def test_shared_layer_is_changed_once():
    net, x = with_random_parameters(Shared), np.sin(np.arange(20, dtype="f")).reshape(5, 4)
    model = trained((".*", LoRA(rank=2)), seed=1, net=net)
    merged = lorasp_jax.merge(model)
    assert merged.first is merged.second
    expected = call(model, x)
    assert_close(call(merged, x), expected)
    unmerged = lorasp_jax.unmerge(merged, model)
    assert_close(unmerged.first.kernel.get_value(), net.first.kernel.get_value())
    assert_close(call(unmerged, x), expected)
    both = lorasp_jax.combine({"a": model, "b": net})
    assert_close(call(lorasp_jax.extract(both, "a"), x), expected)
    assert_close(call(lorasp_jax.choose(both, None), x), call(net, x))
