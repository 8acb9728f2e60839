"""Compare a weighted sum of adapters with each adapter's own `apply`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax import peft
from lorasp_jax.adapters.combine.adapter_set import AdapterSet, empty_bank, get_slot, set_slot
from lorasp_jax.peft import DoRA, LoRA, LoRAMoE, LoRASP
from tests.models.random_models import with_noise

D_IN, D_OUT = 6, 5
LORAS = {"a": LoRA(rank=2, alpha=3), "b": LoRA(rank=4, alpha=5, rank_stabilized=True)}
OTHERS = {
    "sp": LoRASP(rank=8, hidden_width=4),
    "moe": LoRAMoE(experts=2, rank=2),
    "dora": DoRA(rank=2),
    "ada": peft.AdaLoRA(rank=3),
}
METHODS = LORAS | OTHERS
WEIGHTS = np.random.default_rng(5).normal(size=(4, len(METHODS))).astype("f")
SET = AdapterSet(tuple(METHODS), tuple(OTHERS.get(name) for name in METHODS))


@pytest.fixture(scope="module")
def kernel():
    return np.random.default_rng(0).normal(size=(D_IN, D_OUT)).astype("f")


@pytest.fixture(scope="module")
def x():
    return np.random.default_rng(1).normal(size=(4, 3, D_IN)).astype("f")


@pytest.fixture(scope="module")
def members(kernel):
    """Parameters of each adapter, with noise added."""
    init = lambda kernel: [m.init(jax.random.key(0), kernel)[0] for m in METHODS.values()]  # noqa: E731
    params = dict(zip(METHODS, jax.jit(init)(kernel), strict=True))
    return {name: with_noise(params[name], 0.5, i) for i, name in enumerate(METHODS)}


@pytest.fixture(scope="module")
def params(members):
    @jax.jit
    def bank(members):
        bank = empty_bank(2, 4, (D_IN, D_OUT))
        for slot, (name, method) in enumerate(LORAS.items()):
            bank = set_slot(bank, slot, method, members[name])
        return bank

    return {"bank": bank(members), "others": {name: members[name] for name in OTHERS}}


@jax.jit
def apply(params, choice, x, kernel):
    return SET.apply(params | {"choice": choice}, x, kernel)


@jax.jit
def separate(members, x, kernel):
    return {name: method.apply(members[name], x, kernel) for name, method in METHODS.items()}


@pytest.mark.parametrize("name", METHODS)
def test_single_adapter_matches_its_own_method(params, members, x, kernel, name):
    choice = np.array([float(other == name) for other in METHODS], "f")
    y, aux = apply(params, choice, x, kernel)
    expected, report = separate(members, x, kernel)[name]
    np.testing.assert_allclose(y, expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(aux.active_rank, report.active_rank)


def test_zero_weights_give_the_base(params, x, kernel):
    y, aux = apply(params, np.zeros(len(METHODS), "f"), x, kernel)
    np.testing.assert_allclose(y, x @ kernel, rtol=1e-5, atol=1e-5)
    assert not np.any(aux.active_rank)
    assert not aux.losses


def deltas(members, x, kernel):
    results = separate(members, x, kernel)
    return np.stack([np.asarray(results[name][0]) - x @ kernel for name in METHODS])


def test_weighted_sum(params, members, x, kernel):
    weights = np.array([0.5, -1.0, 0.25, 2.0, 0.3, 1.0], "f")
    y, _ = apply(params, weights, x, kernel)
    expected = x @ kernel + np.tensordot(weights, deltas(members, x, kernel), 1)
    np.testing.assert_allclose(y, expected, rtol=1e-4, atol=1e-4)


def test_choice_per_example(params, members, x, kernel):
    y, aux = apply(params, WEIGHTS, x, kernel)
    expected = x @ kernel + np.einsum("ba,abto->bto", WEIGHTS, deltas(members, x, kernel))
    np.testing.assert_allclose(y, expected, rtol=1e-4, atol=1e-4)
    assert aux.active_rank.shape == (4, 3)


def test_rows_of_an_example_are_contiguous(params, x, kernel):
    """Fold [B, T, I] into [B T, I], as a vision tower does with its cameras."""
    y, _ = apply(params, WEIGHTS, x, kernel)
    folded, _ = apply(params, WEIGHTS, x.reshape(12, D_IN), kernel)
    np.testing.assert_allclose(np.reshape(folded, y.shape), y, rtol=1e-5, atol=1e-5)
    with pytest.raises(ValueError, match=r"4 examples .* 3 rows"):
        apply(params, WEIGHTS, x[:3], kernel)


def test_without_a_bank(members, x, kernel):
    method = AdapterSet(("sp", "dora"), (OTHERS["sp"], OTHERS["dora"]))
    others = {name: members[name] for name in ("sp", "dora")}
    bank = jax.tree.map(np.asarray, empty_bank(0, 0, (D_IN, D_OUT)))
    params = {"bank": bank, "others": others, "choice": np.array([1.0, 0.0], "f")}
    y, _ = jax.jit(method.apply)(params, x, kernel)
    expected, _ = separate(members, x, kernel)["sp"]
    np.testing.assert_allclose(y, expected, rtol=1e-4, atol=1e-5)


def test_merge(params, members, x, kernel):
    """Merge adapters whose deltas do not depend on the input."""
    mergeable = [name for name in METHODS if name not in ("sp", "moe")]
    method = AdapterSet(tuple(mergeable), tuple(OTHERS.get(name) for name in mergeable))
    own = {"bank": params["bank"], "others": {name: members[name] for name in ("dora", "ada")}}
    own["choice"] = np.array([0.5, -1.0, 1.5, 0.7], "f")
    both = jax.jit(lambda own: (method.apply(own, x, kernel)[0], method.merge(own, kernel)))
    expected, merged = map(np.asarray, both(own))
    np.testing.assert_allclose(x @ merged, expected, rtol=1e-4, atol=1e-4)
    assert jax.eval_shape(method.merge, own, kernel.astype(jnp.bfloat16)).dtype == jnp.bfloat16
    with pytest.raises(ValueError, match="per example"):
        method.merge(own | {"choice": np.ones((2, 4), "f")}, kernel)
    with pytest.raises(ValueError, match="LoRA-SP"):
        jax.eval_shape(SET.merge, params | {"choice": WEIGHTS[0]}, kernel)


def test_low_precision(params, x, kernel):
    low = jnp.bfloat16
    choice = np.full(len(METHODS), 0.3, "f")
    y, _ = apply(params, choice, x.astype(low), kernel.astype(low))
    expected, _ = apply(params, choice, x, kernel)
    assert y.dtype == low
    np.testing.assert_allclose(np.asarray(y, "f"), expected, atol=0.05 * np.abs(expected).max())


@pytest.mark.slow
def test_gradients(params, x, kernel):
    """Inputs, weights and adapters with non-zero weight get gradients; the kernel does not."""
    choice = jnp.zeros(len(METHODS)).at[1].set(1.0)

    def loss(params, choice, x, kernel):
        return jnp.sum(SET.apply(params | {"choice": choice}, x, kernel)[0] ** 2)

    floats = {"others": params["others"]} | {"bank": dict(params["bank"])}
    rank = floats["bank"].pop("rank")

    def loss_of_floats(floats, *rest):
        return loss({**floats, "bank": floats["bank"] | {"rank": rank}}, *rest)

    own, weights, inputs, base = jax.grad(loss_of_floats, (0, 1, 2, 3))(floats, choice, x, kernel)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(own))
    lora_b = own["bank"]["lora_b"]
    assert (lora_b[1] != 0).all()
    assert not lora_b[0].any()
    assert (weights != 0).all()
    assert (inputs != 0).any()
    assert not base.any()


def test_bank_slots_round_trip(members):
    bank = empty_bank(2, 7, (D_IN, D_OUT))
    bank = set_slot(set_slot(bank, 0, LORAS["b"], members["b"]), 0, LORAS["a"], members["a"])
    method, params = get_slot(bank, 0)
    assert (method.rank, method.scale) == (2, 1.5)
    np.testing.assert_array_equal(params["lora_a"], members["a"]["lora_a"])
    np.testing.assert_array_equal(params["lora_b"], members["a"]["lora_b"])
    assert get_slot(bank, 1) == (None, None)
    assert get_slot(set_slot(bank, 0, None, None), 0) == (None, None)
    with pytest.raises(ValueError, match="rank 4 exceeds 3"):
        set_slot(empty_bank(1, 3, (D_IN, D_OUT)), 0, LORAS["b"], members["b"])
