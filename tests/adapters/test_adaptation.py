"""Adapt whole models: rules, stacked layers, splitting, counting, merging."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax import peft
from lorasp_jax.adapters import adaptation
from lorasp_jax.dense import AdapterParam, Dense
from lorasp_jax.peft import DoRA, FullFineTuning, LoRA, LoRASP
from tests.cases import mostly_slow
from tests.models.random_models import with_random_parameters

LAYERS, WIDTH = 3, 4
SP = LoRASP(rank=8, hidden_width=4)


class Net(nnx.Module):
    """An nnx.Linear, a norm, a scanned stack and a list of layers."""

    def __init__(self, rngs, param_dtype=jnp.float32):
        options = {"param_dtype": param_dtype, "rngs": rngs}
        self.inp = nnx.Linear(5, WIDTH, **options)
        self.norm = nnx.RMSNorm(WIDTH, **options)
        stacked = nnx.vmap(lambda r: Dense(WIDTH, WIDTH, param_dtype=param_dtype, rngs=r))
        self.blocks = stacked(rngs.split(LAYERS))
        self.heads = nnx.List([nnx.Linear(WIDTH, 2, use_bias=False, **options) for _ in range(2)])

    def __call__(self, x):
        graphdef, layers = nnx.split(self.blocks)

        def block(x, layer):
            y, aux = nnx.merge(graphdef, layer)(x, return_aux=True)
            return x + jnp.tanh(y), aux

        x, aux = jax.lax.scan(jax.checkpoint(block), self.norm(self.inp(x)), layers)
        return sum(head(x) for head in self.heads), aux


@pytest.fixture(scope="module")
def net():
    return with_random_parameters(lambda: Net(nnx.Rngs(0)))


@pytest.fixture(scope="module")
def x():
    return np.random.default_rng(0).normal(size=(6, 5)).astype("f")


def adapted(net, *rules):
    return adaptation.adapt(net, rules, rngs=nnx.Rngs(1))


@jax.jit
def call(model, x):
    return model(x)


def trained(model, x, steps=2):
    """Run a few Adam steps as the training loop does: split once, merge inside the loss."""
    graphdef, adapters, frozen = adaptation.split(model)
    optimizer = optax.adam(1e-2)

    @jax.jit
    def step(adapters, opt_state):
        def loss(adapters):
            return jnp.mean((nnx.merge(graphdef, adapters, frozen)(x)[0] - 1) ** 2)

        gradients = jax.grad(loss)(adapters)
        updates, opt_state = optimizer.update(gradients, opt_state)
        return optax.apply_updates(adapters, updates), opt_state

    opt_state = optimizer.init(adapters)
    for _ in range(steps):
        adapters, opt_state = step(adapters, opt_state)
    return nnx.merge(graphdef, adapters, frozen)


def leaves(model, kind):
    return jax.tree.leaves(nnx.state(model, kind))


@pytest.mark.parametrize("name", mostly_slow(peft.names(), ["lora_sp", "full"]))
def test_only_adapters_train(net, x, name):
    """The initial output equals the base's, and training does not change the base."""
    method = SP if name == "lora_sp" else peft.create(name)
    model = adapted(net, (".*", method))
    np.testing.assert_allclose(call(model, x)[0], call(net, x)[0], rtol=1e-4, atol=1e-5)
    _, before, frozen = adaptation.split(model)
    after = trained(model, x)
    for old, new in zip(leaves(frozen, ...), leaves(adaptation.split(after)[2], ...), strict=True):
        np.testing.assert_array_equal(old, new)
    now = leaves(after, AdapterParam)
    moved = [not np.array_equal(*pair) for pair in zip(leaves(before, ...), now, strict=True)]
    assert sum(moved) >= len(moved) / 2
    counts = adaptation.count(model)
    assert (counts.trainable == counts.total) == method.trains_base


def test_adapts_linear_and_stacked_layers(net, x):
    model = adapted(net, ("inp|heads", LoRA(rank=2)), ("blocks", SP))
    assert all(isinstance(layer, Dense) for layer in (model.inp, model.heads[0], model.heads[1]))
    assert model.heads[0].bias is None
    shapes = jax.tree.map(jnp.shape, model.blocks.adapter.get_value()["bank"])
    assert shapes == {"u": (LAYERS, 8, WIDTH), "v": (LAYERS, WIDTH, 8)}
    v = model.blocks.adapter.get_value()["bank"]["v"]
    assert not np.array_equal(v[0], v[1])
    _, aux = call(model, x)
    assert aux.active_rank.shape == (LAYERS, 6)
    assert aux.losses["spectral"].shape == (LAYERS,)


def test_the_model_is_not_modified(net):
    before = nnx.graphdef(net), jax.tree.leaves(nnx.state(net))
    model = adapted(net, (".*", LoRA(rank=2)))
    assert nnx.graphdef(net) == before[0]
    assert isinstance(net.inp, nnx.Linear)
    shared = {leaf.unsafe_buffer_pointer() for leaf in before[1]}
    frozen = jax.tree.leaves(adaptation.split(model)[2])
    assert {leaf.unsafe_buffer_pointer() for leaf in frozen} == shared  # no second copy
    trainable = leaves(adapted(net, (".*", FullFineTuning())), AdapterParam)
    assert not shared & {leaf.unsafe_buffer_pointer() for leaf in trainable}  # may be donated


def test_a_rule_may_name_any_path_of_a_shared_layer():
    class Tied(nnx.Module):
        def __init__(self):
            self.a = self.b = nnx.Embed(5, 4, rngs=nnx.Rngs(0))

    model = adapted(Tied(), ("^a$", LoRA(rank=2)), ("^b$", LoRA(rank=3)))
    assert model.a is model.b
    assert model.a.method.rank == 2


def test_first_match_wins_and_none_skips(net):
    model = adapted(net, ("heads/1", None), ("inp|heads", LoRA(rank=2)), ("", FullFineTuning()))
    assert set(adaptation.methods(model)) == {
        "inp", "heads/0", "norm/scale", "blocks/kernel", "blocks/bias",
    }  # fmt: skip
    assert isinstance(model.heads[1], nnx.Linear)


def test_initial_adapters_depend_only_on_key_and_path(net):
    one, two = adapted(net, ("heads/1", SP)), adapted(net, ("inp", None), (".*", SP))

    def v(layer):
        return layer.adapter.get_value()["bank"]["v"]

    np.testing.assert_array_equal(v(one.heads[1]), v(two.heads[1]))
    assert not np.array_equal(v(two.heads[0]), v(two.heads[1]))


def test_full_fine_tuning_unfreezes_everything_under_a_path(x):
    net = with_random_parameters(lambda: Net(nnx.Rngs(0), param_dtype=jnp.bfloat16))
    model = adapted(net, ("norm|blocks", FullFineTuning()))
    assert set(adaptation.methods(model)) == {"norm/scale", "blocks/kernel", "blocks/bias"}
    assert {leaf.dtype for leaf in leaves(model, AdapterParam)} == {jnp.dtype("float32")}
    assert leaves(net, nnx.Param)[0].dtype == jnp.bfloat16
    with_bias = adapted(net, ("bias$", FullFineTuning()), ("blocks", LoRA(rank=2)))
    assert set(adaptation.methods(with_bias)) == {"inp/bias", "blocks/bias", "blocks"}


def test_adapting_a_fully_fine_tuned_layer_freezes_it(net):
    full = adapted(net, (".*", FullFineTuning()))
    model = adapted(full, ("inp", LoRA(rank=2)), (".*", None))
    assert isinstance(model.inp, nnx.Linear) or model.inp.method == LoRA(rank=2)
    assert not isinstance(model.inp.kernel, AdapterParam)


def test_an_adapter_is_never_replaced(net, x):
    """It may already be trained; adapters on other layers are unchanged."""
    model = trained(adapted(net, ("inp", LoRA(rank=2))), x)
    with pytest.raises(ValueError, match=r"adapt inp: .* already"):
        adapted(model, (".*", LoRA(rank=3)))
    both = adapted(model, ("inp", None), (".*", LoRA(rank=3)))
    np.testing.assert_allclose(call(both, x)[0], call(model, x)[0], rtol=1e-5, atol=1e-6)
    merged = adapted(lorasp_jax.merge(model), (".*", LoRA(rank=3)))
    np.testing.assert_allclose(call(merged, x)[0], call(model, x)[0], rtol=1e-4, atol=1e-5)


def test_rules_that_apply_to_nothing(net):
    with pytest.raises(ValueError, match=r"'block/' .*blocks"):
        adapted(net, ("block/", LoRA(rank=2)))
    with pytest.raises(ValueError, match="rule 'norm'"):
        adapted(net, ("norm", LoRA(rank=2)))  # a norm is not a dense layer
    with pytest.raises(ValueError, match="rule 'inp'"):
        adapted(net, (".*", LoRA(rank=2)), ("inp", SP))  # shadowed
    with pytest.raises(ValueError, match="rule 'haeds'"):
        adapted(net, ("haeds", None), (".*", SP))


def test_linear_with_a_custom_precision_is_rejected():
    net = nnx.Linear(3, 4, precision="highest", rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="precision"):
        adapted(net, ("", LoRA(rank=2)))


def test_a_single_layer_is_a_model(x):
    layer = nnx.Linear(5, 2, rngs=nnx.Rngs(0))
    model = adapted(layer, ("", LoRA(rank=2)))
    np.testing.assert_allclose(model(x), layer(x), rtol=1e-5, atol=1e-6)


def test_adapting_and_counting_an_abstract_model():
    """Under eval_shape, models that are too large to build can be adapted and counted."""
    model = nnx.eval_shape(lambda: adapted(Net(nnx.Rngs(0)), ("blocks", SP)))
    per_layer = 8 * (WIDTH + WIDTH) + 4 * (WIDTH + 8) + 4 + 8
    assert adaptation.count(model).trainable == LAYERS * per_layer
    base = 5 * WIDTH + WIDTH + WIDTH + LAYERS * (WIDTH + 1) * WIDTH + 2 * WIDTH * 2
    assert adaptation.count(model).total == base + LAYERS * per_layer


def test_summary(net):
    text = lorasp_jax.summary(adapted(net, ("blocks", SP), ("norm", FullFineTuning())))
    rows = {line.split()[0]: line.split() for line in text.splitlines()}
    assert rows["path"] == ["path", "method", "shape", "rank", "parameters", "trainable"]
    assert rows["blocks"] == ["blocks", "lora_sp", "3x4x4", "8", "432", "372"]
    assert rows["norm/scale"] == ["norm/scale", "full", "4", "-", "4", "4"]
    assert rows["total"] == ["total", "476", "376"]
    assert text.endswith("78.99% of parameters trainable (376 of 476); entirely frozen: heads, inp")


def test_merge_equals_forward(net, x):
    model = adapted(net, ("inp|blocks", LoRA(rank=2)), ("heads", FullFineTuning()))
    model = trained(model, x)
    merged = lorasp_jax.merge(model)
    assert not leaves(merged, AdapterParam)
    assert model.blocks.adapter is not None
    np.testing.assert_allclose(call(merged, x)[0], call(model, x)[0], rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match=r"merge blocks: .* distill"):
        lorasp_jax.merge(adapted(net, ("blocks", SP)))


def test_nnx_tree_mode(net, x):
    """Splitting, training and merging also run with NNX's upcoming defaults."""
    model = adapted(net, (".*", SP))
    graphdef, adapters, frozen = adaptation.split(model)
    with nnx.set_graph_mode(False):
        y, _ = jax.jit(lambda a: nnx.merge(graphdef, a, frozen)(x))(adapters)
    np.testing.assert_allclose(y, call(model, x)[0], rtol=1e-5, atol=1e-5)


RANKS = {LoRA: (2, 0, 3), DoRA: (2, 1, 3)}


@functools.cache
def trained_by_rank(kind):
    """A stack with ranks by layer, before and after steps with momentum and weight decay."""
    net = with_random_parameters(lambda: Net(nnx.Rngs(0)))
    before = adapted(net, ("blocks", kind(rank=3, ranks=RANKS[kind], dropout=0.5)))
    graphdef, adapters, frozen = adaptation.split(before)
    optimizer = optax.adamw(1e-2, weight_decay=0.1)
    x = np.random.default_rng(0).normal(size=(6, 5)).astype("f")

    def loss(adapters, key):
        model = adaptation.with_dropout(nnx.merge(graphdef, adapters, frozen, copy=True), key)
        return (model(x)[0] ** 2).mean()

    @jax.jit
    def step(adapters, state, key):
        updates, state = optimizer.update(jax.grad(loss)(adapters, key), state, adapters)
        return optax.apply_updates(adapters, updates), state

    state = optimizer.init(adapters)
    for key in jax.random.split(jax.random.key(0), 4):
        adapters, state = step(adapters, state, key)
    return before, nnx.merge(graphdef, adapters, frozen)


@pytest.mark.parametrize("kind", RANKS)
def test_directions_beyond_a_rank_stay_zero_to_the_bit(kind):
    for model, is_trained in zip(trained_by_rank(kind), (False, True), strict=True):
        values = model.blocks.adapter.get_value()
        for i, rank in enumerate(RANKS[kind]):
            a, b = (np.asarray(values[name][i]) for name in ("lora_a", "lora_b"))
            for beyond in (a[:, rank:], b[rank:]):
                assert not beyond.view(np.uint32).any()  # no negative zeros either
            assert a[:, :rank].all()
            assert b[:rank].all() == (is_trained or not rank)


@pytest.mark.parametrize("kind", RANKS)
def test_ranks_by_layer_are_counted_and_reported(kind, x):
    _, model = trained_by_rank(kind)
    size = sum(RANKS[kind]) * 2 * WIDTH + (kind is DoRA) * LAYERS * WIDTH
    assert adaptation.count(model).trainable == size
    assert adaptation.count(model).total == adaptation.count(adaptation.merge(model)).total + size
    shapes = nnx.eval_shape(lambda: adapted(Net(nnx.Rngs(0)), ("blocks", model.blocks.method)))
    assert adaptation.count(shapes) == adaptation.count(model) or kind is DoRA
    y, aux = call(model, x)
    assert [*aux.active_rank.mean(1)] == [*RANKS[kind]]
    merged = lorasp_jax.merge(model)
    np.testing.assert_allclose(call(merged, x)[0], y, rtol=1e-4, atol=1e-5)
    assert f" {min(RANKS[kind])}-3 " in lorasp_jax.summary(model)


def test_ranks_by_layer_of_eva(net):
    """Each layer has its leading directions."""
    roots = np.random.default_rng(0).normal(size=(LAYERS, WIDTH, WIDTH)).astype("f")
    moments = {"blocks": jnp.einsum("lik,ljk->lij", roots, roots)}
    adapt = lambda method: adaptation.adapt(  # noqa: E731
        net, [("blocks", method)], rngs=nnx.Rngs(0), statistics=moments
    )
    whole, some = (
        adapt(LoRA(rank=3, initialization="eva", ranks=ranks)).blocks.adapter.get_value()["lora_a"]
        for ranks in ((), (2, 0, 3))
    )
    for i, rank in enumerate((2, 0, 3)):
        np.testing.assert_array_equal(some[i, :, :rank], whole[i, :, :rank])
        assert not some[i, :, rank:].any()


def test_ranks_of_another_stack(net):
    with pytest.raises(ValueError, match=r"adapt blocks: ranks must .* stack \(3\), got 2"):
        adapted(net, ("blocks", LoRA(rank=2, ranks=(1, 2))))
    with pytest.raises(ValueError, match=r"adapt inp: ranks must .* stack \(1\), got 3"):
        adapted(net, ("inp", LoRA(rank=2, ranks=(1, 2, 0))))
    with pytest.raises(ValueError, match="ranks must have one entry"):
        Dense(2, 2, method=LoRA(rank=2, ranks=(1, 2)), rngs=nnx.Rngs(0))
    for ranks in ((1, 3), (-1, 2), (0, 0)):
        with pytest.raises(ValueError, match="ranks must be from 0 to rank 2, not all 0"):
            LoRA(rank=2, ranks=ranks)
