"""Scheduled energy targets: values, gate, and updates by the optimizer."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from lorasp_jax.config import OptimConfig
from lorasp_jax.kernels.energy_gate import energy_gate
from lorasp_jax.peft import AdaLoRA, EnergySchedule, LoRASP
from lorasp_jax.peft.lora_sp import schedule
from lorasp_jax.training.optim import make_optimizer

pytestmark = pytest.mark.slow

KERNEL = jax.ShapeDtypeStruct((6, 5), jnp.float32)
METHOD = LoRASP(rank=8, hidden_width=4, schedule=EnergySchedule(0.5))


def test_values():
    progress = jnp.array([0.0, 0.1, 0.25, 0.5, 0.9])
    linear = EnergySchedule(0.5).target(progress, 0.9)
    np.testing.assert_allclose(linear, [0.5, 0.58, 0.7, 0.9, 0.9], rtol=1e-6)
    cosine = EnergySchedule(1.0, "cosine").target(progress, 0.8)
    expected = 0.8 + 0.2 * (1 + math.cos(math.pi / 5)) / 2
    np.testing.assert_allclose(cosine, [1.0, expected, 0.9, 0.8, 0.8], rtol=1e-6)


@pytest.mark.parametrize("target", [0.3, 0.5, 0.77, 1.0])
def test_scheduled_gate_equals_the_gate(target):
    scores = jax.nn.softplus(3 * jax.random.normal(jax.random.key(0), (200, 24)))
    scores = scores.at[:3].set(0).at[3:9].set(2.0)
    actual = jax.jit(schedule.scheduled_gate)(scores, jnp.float32(target))
    np.testing.assert_array_equal(actual, energy_gate(scores, target, implementation="sort")[0])


@pytest.mark.parametrize("granularity", ["token", "sample"])
def test_progress_needs_no_recompilation(granularity):
    scheduled = dataclasses.replace(METHOD, granularity=granularity)
    params, _ = scheduled.init(jax.random.key(0), KERNEL)
    params["router"]["w2"] = jax.random.normal(jax.random.key(1), (4, 8))
    x = jax.random.normal(jax.random.key(2), (3, 4, 6))
    run = jax.jit(scheduled.delta)
    for progress, target in ((0.0, 0.5), (0.25, 0.7), (1.0, 0.9)):
        _, aux = run(params | {"progress": jnp.float32(progress)}, x)
        constant = LoRASP(rank=8, hidden_width=4, energy_target=target, granularity=granularity)
        _, expected = constant.delta({k: params[k] for k in ("bank", "router")}, x)
        np.testing.assert_array_equal(aux.active_rank, expected.active_rank)
        # It is a difference of two numbers close to 1.
        np.testing.assert_allclose(aux.losses["spectral"], expected.losses["spectral"], atol=1e-5)
    assert run._cache_size() == 1


def test_optimizer_updates_progress_despite_weight_decay():
    """Single and stacked layers with different schedules, and AdaLoRA, in one tree."""
    other = dataclasses.replace(METHOD, schedule=EnergySchedule(0.95, "cosine"))
    key = jax.random.key(0)
    stacked = jax.vmap(lambda key: other.init_params(key, 6, 5))(jax.random.split(key, 3))
    ada = AdaLoRA(rank=4, target_rank=2, interval=1)
    params = {
        "single": METHOD.init_params(key, 6, 5),
        "stack": stacked,
        "ada": ada.init_params(key, 6, 5),
        "constant": LoRASP(rank=4, hidden_width=4).init_params(key, 6, 5),
    }
    optimizer = make_optimizer(OptimConfig(steps=4, weight_decay=0.9), [METHOD, ada, other])
    state = optimizer.init(params)

    @jax.jit
    def step(params, state):
        updates, state = optimizer.update(jax.tree.map(jnp.ones_like, params), state, params)
        return optax.apply_updates(params, updates), state

    for progress in (0.25, 0.5, 0.75, 1.0):
        params, state = step(params, state)
        np.testing.assert_allclose(params["single"]["progress"], progress, rtol=1e-6)
        np.testing.assert_allclose(params["stack"]["progress"], [progress] * 3, rtol=1e-6)
    assert (params["ada"]["lora_e"] == 0).any()
    assert step._cache_size() == 1


def test_progress_has_no_gradient_and_exists_only_with_a_schedule():
    params, _ = METHOD.init(jax.random.key(0), KERNEL)
    x = jax.random.normal(jax.random.key(2), (4, 6))

    def loss(params):
        y, aux = METHOD.delta(params, x)
        return y.sum() + sum(aux.losses.values())

    assert jax.grad(loss)(params)["progress"] == 0
    assert "progress" not in LoRASP(rank=8).init(jax.random.key(0), KERNEL)[0]
    optimizer = optax.sgd(1.0)
    assert LoRASP().transform(optimizer, 4) is optimizer


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"start": 0.0}, r"schedule.start must be in \(0, 1\], got 0.0"),
        ({"share": 0.0}, r"schedule.share must be in \(0, 1\], got 0.0"),
        ({"curve": "square"}, "schedule.curve must be one of 'linear', 'cosine', got 'square'"),
    ],
)
def test_invalid_fields(fields, message):
    with pytest.raises(ValueError, match=message):
        EnergySchedule(**fields)
