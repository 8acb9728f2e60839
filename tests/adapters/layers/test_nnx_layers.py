"""Adapted layers of third-party NNX models: einsums, embeddings, convolutions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax import peft
from lorasp_jax.adapters import adaptation, paths
from lorasp_jax.adapters.io.native import load_adapters, save_adapters
from lorasp_jax.dense import AdapterParam
from lorasp_jax.peft import DoRA, FullFineTuning, LoRA, LoRASP
from tests.cases import mostly_slow
from tests.models.random_models import with_noise, with_random_parameters

SP = LoRASP(rank=8, hidden_width=4)


class Heads(nnx.Module):
    """General, einsum and expert layers, and a scanned stack of einsums."""

    def __init__(self, rngs):
        init = nnx.initializers.normal()
        self.split = nnx.LinearGeneral(6, (2, 3), rngs=rngs, bias_init=init)
        self.experts = nnx.Einsum("bnh,nhk->bnk", (2, 3, 3), (2, 3), rngs=rngs, bias_init=init)
        self.join = nnx.LinearGeneral((2, 3), 6, axis=(-2, -1), use_bias=False, rngs=rngs)
        stacked = nnx.vmap(lambda r: nnx.Einsum("...d,fd->...f", (6, 6), rngs=r))
        self.blocks = stacked(rngs.split(3))

    def __call__(self, x):
        x = self.join(jnp.tanh(self.experts(self.split(x))))
        graphdef, layers = nnx.split(self.blocks)
        return jax.lax.scan(lambda x, one: (x + nnx.merge(graphdef, one)(x), None), x, layers)[0]


class Vision(nnx.Module):
    def __init__(self, rngs):
        self.embed = nnx.Embed(7, 4, rngs=rngs)
        self.conv = nnx.Conv(4, 5, (3,), strides=2, padding="CAUSAL", rngs=rngs)

    def __call__(self, ids):
        return self.conv(self.embed(ids)).sum(-2), self.embed.attend(jnp.ones((2, 4)))


def adapted(model, *rules, **settings):
    return adaptation.adapt(model, rules, rngs=nnx.Rngs(1), **settings)


def perturbed(model):
    """Add noise to the adapters, so that their deltas are not zero."""
    graphdef, adapters, frozen = adaptation.split(model)
    return nnx.merge(graphdef, with_noise(adapters, 0.3), frozen)


call = jax.jit(lambda model, *args: model(*args))


@pytest.fixture(scope="module")
def heads():
    return with_random_parameters(lambda: Heads(nnx.Rngs(0)))


@pytest.fixture(scope="module")
def x():
    return jax.random.normal(jax.random.key(0), (4, 6))


@pytest.fixture(scope="module")
def vision():
    return with_random_parameters(lambda: Vision(nnx.Rngs(0)))


@pytest.fixture(scope="module")
def ids():
    return jnp.array([[1, 2, 3, 3, 0], [6, 5, 4, 1, 1]])


@pytest.mark.parametrize("name", mostly_slow(peft.names(), ["lora"]))
def test_every_method_starts_at_the_base(heads, x, name):
    method = SP if name == "lora_sp" else peft.create(name)
    model = adapted(heads, (".*", method))
    np.testing.assert_allclose(call(model, x), call(heads, x), rtol=1e-4, atol=1e-5)
    assert jnp.abs(call(perturbed(model), x) - call(heads, x)).max() > 1e-2


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [LoRA(rank=2), DoRA(rank=2), LoRA(rank=2, initialization="pissa")]
)
def test_merging_restores_the_original_classes(heads, x, method):
    """Outputs and graph structure are the same, so the model's own code can load the state."""
    model = perturbed(adapted(heads, (".*", method)))
    merged = lorasp_jax.merge(model)
    np.testing.assert_allclose(call(merged, x), call(model, x), rtol=1e-4, atol=1e-5)
    assert type(merged.split) is nnx.LinearGeneral
    loaded = nnx.merge(nnx.graphdef(heads), nnx.state(merged))
    np.testing.assert_array_equal(call(loaded, x), call(merged, x))
    assert isinstance(model.split, nnx.LinearGeneral)


def test_shapes_counts_and_paths(heads):
    model = adapted(heads, (".*", LoRA(rank=2)))
    shapes = {p: l.adapter.get_value()["lora_a"].shape for p, _, _, l in layers(model)}
    assert shapes == {"split": (6, 2), "experts": (2, 3, 2), "join": (6, 2), "blocks": (3, 6, 2)}
    assert adaptation.count(model).trainable == 24 + 2 * 12 + 24 + 3 * 24
    assert set(adaptation.methods(model)) == set(shapes)


def layers(model):
    return paths.locate_layers(nnx.List([model]))


def test_save_and_load(heads, vision, x, tmp_path):
    for bare, args, rules in (
        (heads, (x,), [("bias$", FullFineTuning()), ("split", SP), (".*", LoRA(rank=2))]),
        (vision, (jnp.array([[1, 2]]),), [(".*", LoRA(rank=2))]),
    ):
        model = perturbed(adapted(bare, *rules))
        save_adapters(tmp_path, model)
        loaded = call(load_adapters(tmp_path, bare), *args)
        jax.tree.map(np.testing.assert_array_equal, loaded, call(model, *args))


def test_aux_summary_and_repr(heads, x):
    model = adapted(heads, ("split|experts", SP), ("join", LoRA(rank=2)))
    assert "AdapterParam" in repr(model)
    assert "LoRASP(rank=8" in repr(model)
    _, aux = jax.jit(lambda model, x: (model(x), lorasp_jax.collect_aux(model)))(model, x)
    assert aux["experts"].active_rank.shape == (2, 4)
    rows = {line.split()[0]: line.split() for line in lorasp_jax.summary(model, aux).splitlines()}
    assert rows["path"][-2:] == ["active", "rank"]
    active_rank = float(aux["experts"].active_rank.mean())
    assert rows["experts"][:4] == ["experts", "lora_sp", "2x3x3", "8"]
    assert float(rows["experts"][-1]) == pytest.approx(active_rank, abs=0.06)
    assert (rows["join"][-1], rows["blocks"][-1]) == ("2.0", "-")
    assert "active" not in lorasp_jax.summary(model)
    with pytest.raises(ValueError, match="aux has 'other', which is not a layer"):
        lorasp_jax.summary(model, {"other": aux["join"]})


@pytest.mark.slow
def test_penalties(heads):
    model = perturbed(adapted(heads, ("split|experts", peft.create("ada_lora"))))
    norms = []
    for name in ("split", "experts"):
        params = getattr(model, name).adapter.get_value()
        a = params["lora_a"].reshape(-1, *params["lora_a"].shape[-2:])
        b = params["lora_b"].reshape(-1, *params["lora_b"].shape[-2:])
        eye = np.eye(a.shape[-1])
        for one, two in zip(a, b, strict=True):
            sides = (one.T @ one - eye, two @ two.T - eye)
            norms.append(sum(np.linalg.norm(side) for side in sides) / 2)
    values = adaptation.penalties(model)
    np.testing.assert_allclose(values["orthogonality"], np.mean(norms), rtol=1e-4)


def test_flax_attention(x):
    attention = nnx.MultiHeadAttention(2, 6, decode=False, rngs=nnx.Rngs(0))
    model = adapted(attention, ("query|value", SP), ("out", LoRA(rank=2)))
    x = x[None]
    np.testing.assert_allclose(call(model, x), call(attention, x), rtol=1e-5, atol=1e-6)
    assert set(adaptation.methods(model)) == {"query", "value", "out"}


@pytest.mark.slow
def test_embedding_and_convolution(vision, ids):
    """Compare with a base model with kernels W + scale A B, and with PEFT's initialization."""
    method = LoRA(rank=3, alpha=6.0)
    model = adapted(vision, (".*", method))
    start = model.embed.adapter.get_value()
    assert not start["lora_a"].any()
    assert 0.5 < start["lora_b"].std() < 1.5
    conv = model.conv.adapter.get_value()
    assert (conv["lora_a"].shape, conv["lora_b"].shape) == ((12, 3), (3, 5))
    assert 0.2 < jnp.abs(conv["lora_a"]).max() <= 12**-0.5  # U(±1/√(sizes · I)), as in torch
    assert not conv["lora_b"].any()
    jax.tree.map(np.testing.assert_array_equal, call(model, ids), call(vision, ids))
    model = perturbed(model)
    merged = nnx.clone(vision)
    for name, layer in (("embedding", "embed"), ("kernel", "conv")):
        params, base = getattr(model, layer).adapter.get_value(), getattr(merged, layer)
        delta = 2.0 * params["lora_a"] @ params["lora_b"]
        old = getattr(base, name)
        old.set_value(old.get_value() + delta.reshape(old.get_value().shape))
    for ours, theirs in ((model, merged), (lorasp_jax.merge(model), merged)):
        for actual, expected in zip(call(ours, ids), call(theirs, ids), strict=True):
            np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_two_dimensional_convolution():
    conv = nnx.Conv(2, 4, (3, 2), padding="CIRCULAR", kernel_dilation=2, rngs=nnx.Rngs(0))
    model = perturbed(adapted(conv, ("", LoRA(rank=2))))
    x = jax.random.normal(jax.random.key(0), (2, 2, 6, 5, 2))
    np.testing.assert_allclose(lorasp_jax.merge(model)(x), model(x), rtol=1e-4, atol=1e-5)
    assert lorasp_jax.collect_aux(model)[""].active_rank.shape == (2, 2, 6, 5)


@pytest.mark.slow
def test_only_adapters_get_gradients(vision, ids):
    graphdef, adapters, frozen = adaptation.split(perturbed(adapted(vision, (".*", LoRA(rank=2)))))
    loss = jax.jit(lambda a: sum(y.sum() for y in nnx.merge(graphdef, a, frozen)(ids)))
    gradients = jax.tree.leaves(jax.grad(loss)(adapters))
    assert len(gradients) == 4
    assert all(jnp.abs(g).max() > 0 for g in gradients)


class Product(nnx.Module):
    """A third-party einsum with its own attribute names; reads the shape of its kernel."""

    def __init__(self, einsum_str, shape, rngs):
        self.einsum_str = einsum_str
        self.w = nnx.Param(jax.random.normal(rngs.params(), shape))

    def __call__(self, x):
        return jnp.einsum(self.einsum_str, x, self.w.get_value())

    @property
    def width(self):
        return self.w.get_value().shape[0]


WRONG_EINSUMS = [
    ({Product: lambda layer: ("kernel", "ab,bc->ac")}, "this Product has no parameter 'kernel'"),
    (
        {Product: lambda layer: ("w", None)},
        "the einsums function of Product must return an equation, got None",
    ),
    ({Product: lambda layer: "w"}, "must return \\(name, equation\\), got 'w'"),
    ([Product], "einsums must map layer classes to functions"),
]


@pytest.mark.slow
def test_user_defined_einsums(x, tmp_path):
    product = Product("bd,ndh->nbh", (2, 6, 3), nnx.Rngs(0))
    einsums = {Product: lambda layer: ("w", layer.einsum_str)}
    for wrong, message in WRONG_EINSUMS:
        with pytest.raises(ValueError, match=message):
            adapted(product, ("", SP), einsums=wrong)
    with pytest.raises(ValueError, match=r"unsupported classes: the model \(Product\)\. If such"):
        adapted(product, ("", SP))
    assert "no built-in adapter support for Product" in lorasp_jax.summary(product)
    model = adapted(product, ("", SP), einsums=einsums)
    save_adapters(tmp_path, model)
    loaded = load_adapters(tmp_path, product, einsums=einsums)
    np.testing.assert_array_equal(loaded(x), model(x))
    np.testing.assert_allclose(model(x), product(x), rtol=1e-5, atol=1e-6)
    assert (model.width, isinstance(model, Product)) == (2, True)
    with pytest.raises(ValueError, match="w has an adapter"):
        adapted(product, ("w", FullFineTuning()), ("", LoRA(rank=2)), einsums=einsums)
    free = adapted(product, ("w", FullFineTuning()))
    assert isinstance(free.w, AdapterParam)


class Scaled(nnx.Linear):
    def __call__(self, x):
        return 2 * super().__call__(x)


def test_unsupported_layers(heads, vision):
    for name in ("embed", "conv"):
        for method in (SP, DoRA(rank=2), LoRA(rank=2, initialization="olora")):
            with pytest.raises(
                ValueError, match=f"cannot adapt {name}: .* only supports LoRA whose"
            ):
                adapted(vision, (name, method))
    grouped = nnx.Conv(4, 4, (3,), feature_group_count=2, rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="cannot adapt the model: grouped and masked"):
        adapted(grouped, ("", LoRA(rank=2)))
    exact = nnx.Einsum("ab,bc->ac", (2, 3), precision="highest", rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="with a custom precision"):
        adapted(exact, ("", LoRA(rank=2)))
    with pytest.raises(ValueError, match="applies to nothing"):  # overrides `__call__`
        adapted(Scaled(2, 3, rngs=nnx.Rngs(0)), ("", LoRA(rank=2)))
    with pytest.raises(ValueError, match="adapted layers do not support out_sharding"):
        adapted(heads, ("split", SP)).split(jnp.ones((1, 6)), out_sharding=object())


def test_rules_cover_peft_options(heads):
    """rank_pattern, alpha_pattern, exclude_modules, modules_to_save, bias."""
    rules = [
        ("join", FullFineTuning()),  # modules_to_save
        ("bias$", FullFineTuning()),  # bias="all"
        ("blocks", None),  # exclude_modules
        ("split", LoRA(rank=4, alpha=32)),  # rank_pattern, alpha_pattern
        (".*", LoRA(rank=2)),
    ]
    methods = adaptation.methods(adapted(heads, *rules))
    assert methods == {
        "join/kernel": FullFineTuning(),
        "split/bias": FullFineTuning(),
        "experts/bias": FullFineTuning(),
        "split": LoRA(rank=4, alpha=32),
        "experts": LoRA(rank=2),
    }
