"""Adapt an unmodified Linen model by path rules: every layer type, scan, remat, merging."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.traverse_util import flatten_dict

import lorasp_jax
from lorasp_jax import LinenAdapter, peft
from lorasp_jax.peft import DoRA, FullFineTuning, LoRA, LoRASP
from tests.cases import mostly_slow
from tests.models.random_models import with_noise

SP = LoRASP(rank=8, hidden_width=4)


class Block(nn.Module):
    @nn.compact
    def __call__(self, x, _):
        heads = nn.DenseGeneral((2, 3), name="split")(x)
        heads = nn.Einsum((2, 3, 3), "bnh,nhk->bnk", name="experts")(heads)
        return x + nn.DenseGeneral(6, axis=(-2, -1), name="join")(jnp.tanh(heads)), None


class Net(nn.Module):
    """A third-party model: a scanned and a rematerialized block, all layer types."""

    @nn.compact
    def __call__(self, ids):
        embed = nn.Embed(7, 6, name="embed")
        x = nn.Conv(6, (3,), name="conv")(embed(ids)).sum(-2)
        x, _ = nn.remat(Block)(name="first")(x, None)
        split = {"params": True}
        scanned = nn.scan(Block, {"params": 0}, split_rngs=split, length=3, metadata_params={})
        x, _ = scanned(name="blocks")(x, None)
        dense = nn.Dense(6, name="dense")
        return embed.attend(nn.LayerNorm(name="norm")(dense(dense(x))))


@pytest.fixture(scope="module")
def ids():
    return jnp.array([[1, 2, 3, 3, 0], [6, 5, 4, 1, 1]])


@pytest.fixture(scope="module")
def published(ids):
    """Published parameters, with non-zero biases."""
    shapes = jax.eval_shape(Net().init, jax.random.key(0), ids)
    return with_noise(jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes), 0.4)


def attached(published, ids, *rules):
    adapter = LinenAdapter(Net(), rules)
    return adapter, jax.jit(adapter.attach)(jax.random.key(1), published, ids)


def call(adapter, variables, ids):
    return jax.jit(adapter.apply)(variables, ids)


MATRICES = "first|blocks|dense"


@pytest.mark.parametrize("name", mostly_slow(peft.names(), ["lora"]))
def test_every_method_starts_at_the_base(published, ids, name):
    method = SP if name == "lora_sp" else peft.create(name)
    adapter, variables = attached(published, ids, ("split|experts|dense", method))
    expected = call(Net(), published, ids)
    np.testing.assert_allclose(call(adapter, variables, ids), expected, rtol=1e-4, atol=1e-4)
    other = variables | {"adapters": with_noise(variables["adapters"], 0.3)}
    assert jnp.abs(call(adapter, other, ids) - expected).max() > 1e-2
    if not method.trains_base:
        jax.tree.map(np.testing.assert_array_equal, variables["params"], published["params"])


@pytest.mark.slow
def test_init_matches_the_model(ids):
    adapter = LinenAdapter(Net(), [(".*", LoRA(rank=2))])
    variables = jax.jit(adapter.init)(jax.random.key(0), ids)
    own = jax.jit(Net().init)(jax.random.key(0), ids)
    jax.tree.map(np.testing.assert_array_equal, variables["params"], own["params"])
    assert set(variables) == {"params", "adapters"}


def test_stacks_have_stacked_adapters(published, ids):
    _, variables = attached(published, ids, (".*", LoRA(rank=2)))
    flat = flatten_dict(variables["adapters"], sep="/")
    shapes = {path.replace("/lorasp_adapter", ""): leaf.shape for path, leaf in flat.items()}
    assert shapes["blocks/split/lora_a"] == (3, 6, 2)
    assert shapes["blocks/experts/lora_a"] == (3, 2, 3, 2)
    assert shapes["first/join/lora_a"] == (6, 2)
    assert shapes["conv/lora_a"] == (18, 2)
    a = flat["blocks/split/lorasp_adapter/lora_a"]
    assert not np.array_equal(a[0], a[1])
    assert not flat["embed/lorasp_adapter/lora_a"].any()


@pytest.mark.parametrize(
    "rules",
    [
        [(".*", LoRA(rank=2, alpha=5.0))],
        pytest.param([("embed|conv", None), (MATRICES, DoRA(rank=2))], marks=pytest.mark.slow),
        pytest.param([(MATRICES, LoRA(rank=2, initialization="pissa"))], marks=pytest.mark.slow),
        pytest.param(
            [("bias|norm", FullFineTuning()), ("first", LoRA(rank=2))], marks=pytest.mark.slow
        ),
    ],
)
def test_merged_equals_adapted(published, ids, rules):
    """Merged parameters have the published names and shapes, so the bare model can use them."""
    adapter, variables = attached(published, ids, *rules)
    expected = call(Net(), published, ids)
    np.testing.assert_allclose(call(adapter, variables, ids), expected, rtol=1e-3, atol=1e-3)
    variables = variables | {"adapters": with_noise(variables["adapters"], 0.3)}
    merged = jax.jit(adapter.merge)(variables, ids)
    assert jax.tree.map(jnp.shape, merged) == jax.tree.map(jnp.shape, published)
    y = call(adapter, variables, ids)
    np.testing.assert_allclose(call(Net(), merged, ids), y, rtol=1e-3, atol=1e-3)


def test_adapted_matches_a_manually_merged_kernel(published, ids):
    adapter, variables = attached(published, ids, ("embed|blocks/split", LoRA(rank=2, alpha=6)))
    variables = variables | {"adapters": with_noise(variables["adapters"], 0.3)}
    trained = variables["adapters"]
    params = jax.tree.map(lambda v: v, published["params"])
    delta = {
        path: 3 * own["lorasp_adapter"]["lora_a"] @ own["lorasp_adapter"]["lora_b"]
        for path, own in (("embed", trained["embed"]), ("split", trained["blocks"]["split"]))
    }
    params["embed"]["embedding"] += delta["embed"]
    params["blocks"]["split"]["kernel"] += delta["split"].reshape(3, 6, 2, 3)
    expected = call(Net(), {"params": params}, ids)
    np.testing.assert_allclose(call(adapter, variables, ids), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_gradients_and_aux(published, ids):
    adapter, variables = attached(published, ids, ("embed|conv", LoRA(rank=2)), (MATRICES, SP))

    def loss(adapters):
        full = variables | {"adapters": adapters}
        y, updated = adapter.apply(full, ids, mutable=["intermediates"])
        return jnp.sum(y**2), lorasp_jax.collect_aux(updated)

    gradients, aux = jax.jit(jax.grad(loss, has_aux=True))(with_noise(variables["adapters"], 0.3))
    assert all(jnp.abs(g).max() > 0 for g in jax.tree.leaves(gradients))
    assert {"embed", "conv", "first/split", "first/experts", "first/join", "dense"} == set(aux)
    assert aux["first/experts"].active_rank.shape == (2, 2)


@pytest.mark.slow
def test_fully_fine_tuned_parameters_are_fp32(ids):
    half = jax.tree.map(lambda v: v.astype(jnp.bfloat16), Net().init(jax.random.key(0), ids))
    adapter, variables = attached(half, ids, ("bias$|norm", FullFineTuning()), ("dense", SP))
    flat = flatten_dict(variables["adapters"], sep="/")
    assert {leaf.dtype for leaf in flat.values()} == {jnp.dtype("float32")}
    assert {"norm/scale", "dense/bias", "blocks/join/bias"} <= set(flat)
    assert "bias" not in variables["params"]["dense"]
    assert call(adapter, variables, ids).shape == (2, 7)


class Product(nn.Module):
    """An einsum that takes its equation as a call argument."""

    shape: tuple

    @nn.compact
    def __call__(self, equation, x):
        return jnp.einsum(equation, x, self.param("w", nn.initializers.normal(), self.shape))


def test_user_defined_einsums():
    class Outer(nn.Module):
        @nn.compact
        def __call__(self, x):
            return Product((2, 6, 3), name="q")("bd,ndh->nbh", x)

    x = jax.random.normal(jax.random.key(0), (4, 6))
    einsums = {Product: lambda layer: ("w", None)}  # the equation is a call argument
    adapter = LinenAdapter(Outer(), [("q", LoRA(rank=2))], einsums)
    variables = with_noise(adapter.init(jax.random.key(0), x), 0.3)
    own = variables["adapters"]["q"]["lorasp_adapter"]
    assert own["lora_a"].shape == (6, 2)
    w = variables["params"]["q"]["w"]
    w = w + 2 * jnp.einsum("dr,rnh->ndh", own["lora_a"], own["lora_b"].reshape(2, 2, 3))
    expected = jnp.einsum("bd,ndh->nbh", x, w)
    np.testing.assert_allclose(adapter.apply(variables, x), expected, rtol=1e-5, atol=1e-5)


def test_rules_that_apply_to_nothing(published, ids):
    with pytest.raises(ValueError, match=r"'frist' .* first/"):
        attached(published, ids, ("frist", SP))
    with pytest.raises(ValueError, match="rule 'dense'"):  # shadowed
        attached(published, ids, (MATRICES, SP), ("dense", LoRA(rank=2)))
    with pytest.raises(ValueError, match="rule 'norm'"):
        attached(published, ids, ("norm", SP))
    with pytest.raises(ValueError, match="adapt embed"):
        attached(published, ids, (".*", SP))
    with pytest.raises(ValueError, match="dense/kernel"):
        attached(published, ids, ("kernel$", FullFineTuning()), ("dense", SP))


def test_wrong_variables(published, ids):
    adapter, variables = attached(published, ids, ("dense", SP))
    with pytest.raises(ValueError, match="dense has no adapter"):
        adapter.apply(published, ids)
    with pytest.raises(ValueError, match="dense has an adapter"):
        LinenAdapter(Net(), [("dense", None)]).apply(variables, ids)
    with pytest.raises(ValueError, match="already have adapters"):
        adapter.attach(jax.random.key(0), variables, ids)
    with pytest.raises(ValueError, match="params"):
        adapter.apply(variables, ids, mutable=True)
    with pytest.raises(ValueError, match="merge dense"):
        adapter.merge(variables, ids)
    exact = LinenAdapter(nn.Dense(3, precision="highest"), [("", SP)])
    with pytest.raises(ValueError, match="precision"):
        exact.init(jax.random.key(0), jnp.ones((1, 2)))
