"""LoRA-SP's equations, losses, parameter counts and its identity with LoRA."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.peft import LoRA, LoRASP, lora_sp

D_IN, D_OUT = 24, 40
KERNEL = jax.ShapeDtypeStruct((D_IN, D_OUT), jnp.float32)


@pytest.fixture(scope="module")
def x():
    return jax.random.normal(jax.random.key(0), (3, 7, D_IN))


def initial(method, key=1):
    return jax.jit(lambda key: method.init(key, KERNEL)[0])(jax.random.key(key))


@pytest.mark.parametrize(
    ("method", "router"),
    [
        (LoRASP(), 32 * (D_IN + 128) + 32 + 128),
        (LoRASP(rank=64, hidden_width=8), 8 * (D_IN + 64) + 8 + 64),
        (LoRASP.paper(), 4 * (D_IN + 128)),
    ],
)
def test_parameter_count(method, router):
    shapes = jax.eval_shape(lambda key: method.init(key, KERNEL)[0], jax.random.key(0))
    count = sum(leaf.size for leaf in jax.tree.leaves(shapes))
    assert count == method.rank * (D_IN + D_OUT) + router


def test_scores_start_at_one(x):
    scores, logits = lora_sp.router_scores(initial(LoRASP())["router"], x)
    assert (scores.shape, logits.shape) == ((3, 7, 128), (3, 7, 128))
    np.testing.assert_allclose(scores, 1, atol=0.15)
    assert np.std(scores) > 1e-3  # never all equal, or the same last directions would go


def test_paper_router_spreads_a_softmax(x):
    """Four softmax values, each the score of a block of 32; non-negative whatever W2 becomes."""
    router = initial(LoRASP.paper())["router"]
    scores, logits = lora_sp.router_scores(router, x)
    np.testing.assert_allclose(scores, np.repeat(jax.nn.softmax(logits), 32, -1), rtol=1e-6)
    pushed, _ = lora_sp.router_scores(router | {"w2": router["w2"] - 0.3}, x)
    assert pushed.min() == 0


def test_unit_scores_and_full_target_equal_lora(x):
    """s = 1 (router weights zero) and η = 1 leave plain LoRA of the same rank and alpha."""
    method = LoRASP(rank=16, energy_target=1.0, alpha=8.0)
    params = initial(method)
    router = params["router"] | {"w2": jnp.zeros((32, 16))}
    u = jax.random.normal(jax.random.key(2), (16, D_OUT))
    params = {"bank": params["bank"] | {"u": u}, "router": router}
    ours, aux = jax.jit(method.delta)(params, x)
    lora = {"lora_a": params["bank"]["v"], "lora_b": u}
    theirs, _ = jax.jit(LoRA(rank=16, alpha=8.0).delta)(lora, x)
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(aux.active_rank, 16)


def test_update_is_u_sigma_v(x):
    """Eqs. (9) and (11) literally, token by token."""
    method = LoRASP(rank=16, energy_target=0.7, alpha=4.0)
    params = initial(method)
    params["bank"]["u"] = jax.random.normal(jax.random.key(2), (16, D_OUT))
    params["router"]["w2"] = jax.random.normal(jax.random.key(3), (32, 16))
    delta, aux = jax.jit(method.delta)(params, x)
    scores, _ = lora_sp.router_scores(params["router"], x)
    mask = np.asarray(jax.jit(lambda s: lora_sp.energy_gate(s, 0.7)[0])(scores))
    u, v = np.asarray(params["bank"]["u"]), np.asarray(params["bank"]["v"])
    token = np.asarray(x)[1, 4]
    expected = 4 / 16 * token @ v @ np.diag(np.where(mask, scores, 0)[1, 4]) @ u
    np.testing.assert_allclose(delta[1, 4], expected, rtol=1e-4, atol=1e-5)
    assert 0 < aux.active_rank.mean() < 16
    assert (aux.kept_energy >= 0.7 - 1e-6).all()


def test_pruned_directions_get_no_task_gradient(x):
    method = LoRASP(rank=16, energy_target=0.5)
    params = initial(method)
    params["bank"]["u"] = jnp.ones((16, D_OUT))

    def task(shift):
        scores = lora_sp.router_scores(params["router"], x)[0] + shift
        mask, _, _ = lora_sp.energy_gate(scores, 0.5)
        return lora_sp.select(x @ params["bank"]["v"], scores, mask).sum(), mask

    gradient, mask = jax.jit(jax.grad(task, has_aux=True))(jnp.zeros((3, 7, 16)))
    np.testing.assert_array_equal(gradient != 0, mask)


def test_losses_of_uniform_and_concentrated_routing():
    """Balance is 1 where all directions are used alike and R where one takes all; z is 0 at 0."""
    valid = jnp.ones(5, bool)
    even, one = jnp.ones((5, 8)), jnp.eye(8)[jnp.zeros(5, int)]
    assert lora_sp.balance_loss(even, even > 0, valid) == pytest.approx(1)
    assert lora_sp.balance_loss(one, one > 0, valid) == pytest.approx(8)
    spread = jnp.eye(8)[:5]  # each token another direction: balanced over tokens
    assert lora_sp.balance_loss(spread, spread > 0, valid) == pytest.approx(8 / 5)
    assert lora_sp.z_loss(jnp.zeros((5, 8)), valid) == pytest.approx(0, abs=1e-6)
    assert lora_sp.z_loss(jnp.full((5, 8), 3.0), valid) == pytest.approx(9, rel=1e-5)
    kept = jnp.array([0.9, 1.0, 0.95, 0.2, 0.1])
    assert lora_sp.spectral_loss(kept, jnp.arange(5) < 3) == pytest.approx(0.05)


def test_rows_without_scores_stay_out(x):
    """A ReLU router can go silent: nothing is kept, nothing is lost, no loss is counted."""
    method = LoRASP.paper()
    params = initial(method)
    params["router"]["w2"] = -params["router"]["w2"]

    def loss(params):
        y, aux = method.delta(params, x)
        return y.sum() + sum(aux.losses.values()), aux

    gradients, aux = jax.jit(jax.grad(loss, has_aux=True))(params)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    np.testing.assert_array_equal(aux.active_rank, 0)
    np.testing.assert_array_equal(aux.kept_energy, 1)
    assert all(value == 0 for value in aux.losses.values())


def test_a_broken_router_is_not_hidden(x):
    params = initial(LoRASP())
    params["router"]["b2"] = params["router"]["b2"].at[3].set(jnp.nan)
    _, aux = jax.jit(LoRASP().delta)(params, x)
    assert all(jnp.isnan(value) for value in aux.losses.values())


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"energy_target": 0.0}, r"energy_target must lie in \(0, 1\], got 0.0"),
        ({"energy_target": 1.5}, r"energy_target must lie in \(0, 1\], got 1.5"),
        ({"rank": 0}, "at least 1"),
        ({"router": "relu"}, "router must be 'gelu' or 'softmax', got 'relu'"),
        ({"router": "softmax", "hidden_width": 5}, "divisible by its width, got 128 and 5"),
    ],
)
def test_bad_fields(fields, message):
    with pytest.raises(ValueError, match=message):
        LoRASP(**fields)


def test_scale_follows_alpha():
    assert LoRASP().scale == LoRASP(rank=16).scale == 2
    assert dataclasses.replace(LoRASP(), alpha=64.0).scale == 0.5
