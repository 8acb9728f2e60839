"""Test AdaLoRA against Hugging Face PEFT, and properties of its rank allocation."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from lorasp_jax.peft import AdaLoRA, LoRA, ada_lora
from tests import GOLDEN

LAYERS = ("lin.0", "lin.1", "lin.2")


def layer(arrays, prefix, suffix=""):
    """A layer's parameters in our layout."""
    a, b, e = (arrays[f"{prefix}.lora_{name}{suffix}"] for name in "ABE")
    return {"lora_a": a.T, "lora_b": b.T, "lora_e": e[:, 0]}


def model(arrays, prefix):
    """Parameters of the three layers that PEFT trained."""
    return {name: {"adapter": layer(arrays, f"{prefix}/{name}")} for name in LAYERS}


@pytest.fixture(scope="module")
def trace():
    return dict(np.load(GOLDEN / "adalora_alloc_train.npz"))


@pytest.fixture(scope="module")
def configured(trace):
    """The method with PEFT's schedule, and the number of steps."""
    cfg = json.loads(str(trace["cfg"]))
    total = cfg["total_step"]
    fractions = {"warmup": cfg["tinit"] / total, "final": cfg["tfinal"] / total}
    ranks = {"rank": cfg["init_r"], "target_rank": cfg["target_r"]}
    return AdaLoRA(**ranks, **fractions, alpha=cfg["lora_alpha"], interval=cfg["deltaT"]), total


@pytest.fixture(scope="module")
def replay(trace, configured):
    """Parameters and optimizer state after each step on PEFT's recorded gradients."""
    method, total = configured
    optimizer = method.transform(optax.sgd(0.05), total)

    @jax.jit
    def step(params, state, grads):
        updates, state = optimizer.update(grads, state, params)
        return optax.apply_updates(params, updates), state

    params = jax.device_put(model(trace, "init"))
    state, history = optimizer.init(params), []
    for t in range(total):
        params, state = step(params, state, model(trace, f"grad/{t}"))
        history.append((params, state))
    return history


def test_masks_and_values_at_every_step(trace, replay):
    checked = 0
    for t, (params, state) in enumerate(replay):
        for name, kept in zip(LAYERS, state.kept, strict=True):
            e = trace[f"E_after/{t}/{name}.lora_E"][:, 0]
            ours = np.asarray(params[name]["adapter"]["lora_e"])
            np.testing.assert_allclose(ours, e, rtol=1e-5, atol=1e-7)
            np.testing.assert_array_equal(ours == 0, e == 0)
            if f"mask/{t}/{name}.lora_E" in trace:
                np.testing.assert_array_equal(kept, trace[f"mask/{t}/{name}.lora_E"])
                checked += 1
    assert checked == 156


def test_final_parameters(trace, replay):
    expected = model(trace, "final")
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6),
        replay[-1][0],
        expected,
    )


@pytest.mark.parametrize("t", [0, 1, 30])
def test_moving_averages(trace, replay, t):
    state = replay[t][1]
    for ours, name in ((state.importance, "ema_ipt"), (state.uncertainty, "ema_unc")):
        for actual, key in zip(ours, LAYERS, strict=True):
            expected = layer(trace, f"{name}/{t}/{key}")
            for leaf in expected:
                np.testing.assert_allclose(actual[leaf], expected[leaf], rtol=1e-4, atol=1e-9)


def test_budgets(trace, configured):
    method, total = configured
    begin, end = round(method.warmup * total), total - round(method.final * total)
    actual = ada_lora.budgets(24, 12, begin, end)
    np.testing.assert_array_equal(actual, trace["budget"][: end + 1])
    long = ada_lora.budgets(128 * 400, 60 * 400, 1000, 10_000)
    t = np.arange(1000, 10_001)
    remaining = [1 - (int(step) - 1000) / 9000 for step in t]
    assert long[t].tolist() == [int((128 - 60) * 400 * x**3 + 60 * 400) for x in remaining]


def test_forward_and_orthogonality():
    arrays = dict(np.load(GOLDEN / "adalora_forward.npz"))
    method, x, penalties = AdaLoRA(rank=6, target_rank=3, alpha=16), arrays["x"], []

    @jax.jit
    def run(params, x, kernel):
        delta, penalty = method.merge(params, jnp.zeros(kernel.shape)), method.penalty(params)
        return *method.apply(params, x, kernel), delta, penalty["orthogonality"]

    for i in range(3):
        name = f"param/lin.{i}"
        kernel, bias = arrays[f"{name}.weight"].T, arrays[f"{name}.bias"]
        y, aux, delta, penalty = run(layer(arrays, name, ".default"), x, kernel)
        np.testing.assert_allclose(delta.T, arrays[f"delta/{i}"], rtol=1e-5, atol=1e-6)
        x = np.asarray(y) + bias if i == 2 else np.tanh(np.asarray(y) + bias)
        assert np.all(aux.active_rank == 6)
        penalties.append(penalty)
    np.testing.assert_allclose(x, arrays["y"], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(np.mean(penalties), arrays["orth_reg_mean"], rtol=1e-5)


def test_equals_lora_without_pruning():
    x, kernel = np.ones((3, 5), "f"), np.ones((5, 7), "f")
    method = AdaLoRA(rank=4, target_rank=2, alpha=6.0)
    params = initial(method, 5, 7) | {"lora_e": np.ones(4, "f")}
    lora = {"lora_a": params["lora_a"], "lora_b": params["lora_b"]}
    expected, _ = jax.jit(LoRA(rank=4, alpha=6.0).apply)(lora, x, kernel)
    y, _ = jax.jit(method.apply)(params, x, kernel)
    np.testing.assert_allclose(y, expected, rtol=1e-5, atol=1e-6)


def initial(method, d_in, d_out, seed=0):
    kernel = np.zeros((d_in, d_out), "f")
    return jax.jit(method.init)(jax.random.key(seed), kernel)[0]


def run(method, params, total, seed=0):
    """Train on random gradients; return the mask of nonzero e of all layers after each step."""
    optimizer = method.transform(optax.adam(1e-2), total)

    def step(carry, key):
        params, state = carry
        leaves, structure = jax.tree.flatten(params)
        keys = jax.random.split(key, len(leaves))
        grads = [jax.random.normal(k, leaf.shape) for k, leaf in zip(keys, leaves, strict=True)]
        updates, state = optimizer.update(jax.tree.unflatten(structure, grads), state, params)
        params = optax.apply_updates(params, updates)
        e = [t["lora_e"].ravel() for t in ada_lora._triplets(params)]
        return (params, state), jnp.concatenate(e) != 0

    keys = jax.random.split(jax.random.key(seed), total)
    return jax.jit(lambda p: jax.lax.scan(step, (p, optimizer.init(p)), keys))(params)


def small(**fields):
    return AdaLoRA(**{"rank": 6, "target_rank": 2, "interval": 3} | fields)


def test_rank_falls_to_the_target_and_stays():
    method = small()
    params = {"first": initial(method, 4, 5), "weight": np.ones(3, "f")}
    params["second"] = initial(method, 8, 3, seed=1)
    (after, state), kept = jax.device_get(run(method, params, 40))
    ranks = kept.sum(1)
    assert np.all(ranks[:4] == 12)
    assert np.all(ranks[28:] == 4)
    assert np.all(kept[28:] == kept[28])
    pruned = np.flatnonzero(ranks[:-1] > ranks[1:]) + 1
    assert len(pruned) > 3
    assert not np.any(pruned % 3 * (pruned != 28))
    assert np.any(kept[1:] & ~kept[:-1])  # pruned triplets still train and can become nonzero
    assert not np.array_equal(after["weight"], params["weight"])  # trained as usual
    assert int(state.step) == 40


def test_stacked_layers_share_the_budget():
    method = small()
    stacked = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), initial(method, 4, 5))
    _, kept = jax.device_get(run(method, {"stack": stacked}, 40))
    assert kept[-1].sum() == 2 * method.target_rank
    shaped = kept[-1].reshape(2, 6).sum(1)
    assert shaped.sum() == 4


def test_target_equal_to_rank_prunes_nothing():
    _, kept = run(small(target_rank=6), {"a": initial(small(), 4, 5)}, 20)
    assert np.all(kept)


def test_ties_at_the_threshold_are_pruned():
    scores = [np.array([3, 1], "f"), np.array([1, 2], "f")]
    kept = jax.jit(ada_lora._keep)(scores, np.array(1))
    assert [k.tolist() for k in kept] == [[True, False], [False, True]]


def test_default_target_is_half_the_rank():
    assert [AdaLoRA(rank=rank).final_rank for rank in (1, 2, 16)] == [1, 1, 8]


def test_match_budget():
    assert AdaLoRA(rank=128).match_budget(75.6) == AdaLoRA(rank=128, target_rank=76)


def test_orthogonal_parameters_have_zero_gradient():
    params = {"lora_a": np.eye(4, 2), "lora_b": np.eye(2, 3), "lora_e": np.ones(2)}
    params = jax.tree.map(np.float32, params)
    gradient = jax.jit(jax.grad(lambda p: small(rank=2).penalty(p)["orthogonality"]))(params)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(gradient))


def test_optimizer_without_adalora_parameters():
    with pytest.raises(ValueError, match="contain no AdaLoRA adapter"):
        small().transform(optax.sgd(1.0), 40).init({"kernel": jnp.ones(3)})


def test_too_few_steps():
    with pytest.raises(ValueError, match="cannot prune in 1 steps"):
        small(warmup=0.2, final=0.6).transform(optax.sgd(1.0), 1)
