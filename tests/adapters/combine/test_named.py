"""Compare combined models with each adapted model, and with Hugging Face PEFT."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.combine import named
from lorasp_jax.adapters.io.native import load_adapters, save_adapters
from lorasp_jax.dense import AdapterParam
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import AdaLoRA, DoRA, FullFineTuning, LoRA, LoRAMoE
from tests.models.random_models import observation, with_random_parameters
from tests.nets import NET, SP, Net, X, assert_close, golden_models, trained

NAMES = ("pour", "press", "open", "pick")
TRACES = []
WEIGHTS = {"pour": 0.5, "press": -0.7}


@functools.cache
def models():
    return {
        "pour": trained(
            ("inp", LoRA(rank=2, alpha=3)), ("blocks", LoRA(rank=3, ranks=(1, 3, 2))), seed=1
        ),
        "press": trained(("", LoRA(rank=4, alpha=5, rank_stabilized=True)), seed=2),
        "open": trained(("inp", SP), ("blocks", DoRA(rank=2)), seed=3),
        "pick": trained(("inp", AdaLoRA(rank=3)), ("blocks", LoRAMoE(experts=2, rank=2)), seed=4),
        "spare": NET,
    }


@functools.cache
def combined():
    separate = models()
    return jax.jit(lambda: lorasp_jax.combine(separate, rank=6))()


@jax.jit
def call(model, x):
    TRACES.append(model)
    return model(x)


@pytest.mark.parametrize("name", NAMES)
def test_each_adapter(name):
    assert_close(call(lorasp_jax.choose(combined(), name), X), call(models()[name], X))


def test_base_and_initial_choice():
    assert_close(call(lorasp_jax.choose(combined(), None), X), call(NET, X))
    assert_close(call(combined(), X), call(models()["pour"], X))
    assert named.names(combined()) == (*NAMES, "spare")


def test_choice_per_example():
    chosen = ["press", "open", None, "pour"]
    y = call(lorasp_jax.choose(combined(), chosen), X)
    alone = [np.asarray(call(models()[n or "spare"], X))[i] for i, n in enumerate(chosen)]
    assert_close(y, np.stack(alone))


def test_choices_do_not_recompile():
    """Change names and weights, by a new model or by an array inside jit."""
    arrays = []

    @jax.jit
    def call_with_array(model, weights, x):
        arrays.append(weights)
        return lorasp_jax.choose(model, weights)(x)

    for choices in (
        ["pour", "open", None, WEIGHTS],
        [["pour", None, "open", WEIGHTS], ["press"] * 4],
    ):
        call(lorasp_jax.choose(combined(), choices[0]), X)
        traces = len(TRACES), len(arrays) + 1
        for choice in choices:
            y = call(lorasp_jax.choose(combined(), choice), X)
            assert_close(call_with_array(combined(), named.weights(combined(), choice), X), y)
        assert (len(TRACES), len(arrays)) == traces


def test_swap_does_not_recompile():
    other = trained(("inp|blocks", LoRA(rank=6, alpha=2.5)), seed=8)
    expected = [call(other, X), call(models()["pour"], X), call(NET, X)]
    model = lorasp_jax.choose(combined(), "spare")
    assert_close(call(model, X), expected[2])
    traces = len(TRACES)
    swapped = [lorasp_jax.swap(model, "spare", one) for one in (other, models()["pour"])]
    for one, y in zip([*swapped, model], expected, strict=True):
        assert_close(call(one, X), y)
    assert len(TRACES) == traces


@pytest.mark.parametrize("name", NAMES)
def test_extracting_an_adapter(tmp_path, name):
    """The extracted adapter is unchanged, trainable, and can be saved."""
    alone = lorasp_jax.extract(combined(), name)
    assert_close(call(alone, X), call(models()[name], X))
    assert adaptation.count(alone).trainable == adaptation.count(models()[name]).trainable
    save_adapters(tmp_path, alone)
    model = lorasp_jax.swap(combined(), name, load_adapters(tmp_path, NET))
    assert_close(call(lorasp_jax.choose(model, name), X), call(models()[name], X))


def test_extracting_the_base():
    base = lorasp_jax.extract(combined(), None)
    assert not adaptation.methods(base)
    np.testing.assert_array_equal(call(base, X), call(NET, X))


def test_combined_model_is_frozen_and_shares_the_base():
    assert not jax.tree.leaves(nnx.state(combined(), AdapterParam))

    separate = models()

    def combine():
        model = lorasp_jax.combine(separate)
        assert model.blocks.kernel.get_value() is NET.blocks.kernel.get_value()
        return model

    jax.eval_shape(combine)
    assert models()["pour"].blocks.method == LoRA(rank=3, ranks=(1, 3, 2))
    models_by_choice = (lorasp_jax.choose(combined(), name) for name in ("pour", "open"))
    assert not np.array_equal(
        *(jax.tree.leaves(nnx.state(model, named.AdapterChoice)) for model in models_by_choice)
    )


def test_unknown_names():
    with pytest.raises(ValueError, match=r"'puor'.* pour"):
        lorasp_jax.choose(combined(), "puor")
    with pytest.raises(ValueError, match="'press2'"):
        lorasp_jax.choose(combined(), ["pour", {"press2": 0.5}])
    with pytest.raises(ValueError, match="'prss'"):
        lorasp_jax.extract(combined(), "prss")
    with pytest.raises(ValueError, match="no named adapters"):
        lorasp_jax.choose(NET, "pour")
    for bad in (jnp.ones(3), [], np.ones((2, 2, 5))):
        with pytest.raises(ValueError, match=r"\[5\] or \[B, 5\]"):
            lorasp_jax.choose(combined(), bad)


def test_combine_errors():
    other = with_random_parameters(Net)
    other.inp.kernel.set_value(np.asarray(other.inp.kernel.get_value()) + 1)
    with pytest.raises(ValueError, match=r"pour and b .*'inp/kernel'"):
        lorasp_jax.combine({"pour": models()["pour"], "b": other})
    with pytest.raises(ValueError, match=r"full .* out/(kernel|bias)"):
        lorasp_jax.combine({"full": trained(("out", FullFineTuning()), seed=0)})
    split = [("inp", LoRA(2, initialization="pissa"))]
    adapt = lambda: adaptation.adapt(NET, split, rngs=nnx.Rngs(0))  # noqa: E731
    with pytest.raises(ValueError, match="inp split"):
        jax.eval_shape(lambda: lorasp_jax.combine({"a": adapt()}))
    with pytest.raises(ValueError, match="already a combined"):
        lorasp_jax.combine({"a": combined()})
    with pytest.raises(ValueError, match="rank 4 exceeds 3"):
        jax.eval_shape(functools.partial(lorasp_jax.combine, models(), rank=3))
    with pytest.raises(ValueError, match="models"):
        lorasp_jax.combine({})


def test_swap_errors():
    with pytest.raises(ValueError, match=r"open at blocks .* DoRA"):
        lorasp_jax.swap(combined(), "open", trained(("inp", SP), seed=0))
    with pytest.raises(ValueError, match=r"pour at blocks .* LoRA"):
        lorasp_jax.swap(combined(), "pour", models()["open"])
    few = {name: models()[name] for name in ("open", "pour")}
    few = jax.jit(functools.partial(lorasp_jax.combine, few))()
    with pytest.raises(ValueError, match="pour adapts out"):
        lorasp_jax.swap(few, "pour", models()["press"])


@functools.cache
def golden_case():
    golden, models = golden_models()
    return golden, jax.jit(lambda: lorasp_jax.combine(models))()


@pytest.mark.parametrize(
    ("case", "choice"),
    [
        ("a", "a"),
        ("b", "b"),
        ("base", None),
        ("a+b", {"a": 1.0, "b": 1.0}),
        ("mixed", ["a", "b", None, "a"]),
        ("cat", {"a": 0.7, "c": 0.3}),
    ],
)
def test_hugging_face(case, choice):
    """PEFT 0.21.2: one, none or two adapters, a mixed batch, a weighted sum; tolerance 1e-5."""
    golden, combined = golden_case()
    model = lorasp_jax.choose(combined, choice)
    expected = golden[f"y/{case}"]
    atol = 1e-5 * np.abs(expected).max()
    np.testing.assert_allclose(call(model, golden["x"]), expected, rtol=0, atol=atol)


@pytest.mark.slow
def test_mixed_batch_through_pi0():
    """Test scanned towers, cameras folded into the batch, and a cache that both experts share."""
    config = Pi0Config.dummy()
    net, obs = config.create(nnx.Rngs(0)), observation(config, 2)
    x_t = jax.random.normal(jax.random.key(4), (2, config.chunk, config.action_dim))
    models = {"a": trained(("vision/.*fc1|v_proj", LoRA(rank=2)), seed=1, net=net)}
    models["b"] = trained(("vision/.*fc|state_proj", LoRA(rank=3)), seed=2, net=net)
    model = lorasp_jax.combine(models)
    velocity = jax.jit(lambda model: model.velocity(obs, x_t, jnp.full(2, 0.4)))
    mixed, a, b = (
        velocity(lorasp_jax.choose(model, c)) for c in (["b", "a"], ["a", "a"], ["b", "b"])
    )
    np.testing.assert_allclose(mixed, jnp.stack([b[0], a[1]]), rtol=1e-3, atol=1e-3)
    assert jnp.abs(a - b).max() > 0.1
