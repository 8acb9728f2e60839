"""Test the sum of auxiliary losses with the default weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen, nnx

import lorasp_jax
from lorasp_jax.config import AuxiliaryConfig
from lorasp_jax.peft import AdaLoRA, LoRA, LoRAMoE, LoRASP

WEIGHTS = AuxiliaryConfig()
SP = LoRASP(rank=6, hidden_width=4)
RULES = [("0", SP), ("1", LoRAMoE(experts=2, rank=2)), ("2", AdaLoRA(rank=4)), ("3", LoRA(rank=2))]


@pytest.fixture
def x():
    return jax.random.normal(jax.random.key(0), (5, 8))


@pytest.fixture
def base():
    return nnx.Sequential(*(nnx.Linear(8, 8, rngs=nnx.Rngs(i)) for i in range(4)))


def test_auxiliary_loss_is_the_weighted_sum_of_all_losses(base, x):
    model = lorasp_jax.adapt(base, RULES, rngs=nnx.Rngs(1))

    @jax.jit
    def losses(model, x):
        model(x)
        total = lorasp_jax.auxiliary_loss(model)
        model(x)
        reports = lorasp_jax.collect_aux(model)
        return total, lorasp_jax.auxiliary_losses(reports) | lorasp_jax.penalties(model)

    total, parts = losses(model, x)
    assert set(parts) == {"spectral", "balance", "z", "orthogonality"}
    expected = sum(getattr(WEIGHTS, name) * value for name, value in parts.items())
    assert (total.shape, total.dtype) == ((), jnp.float32)
    np.testing.assert_allclose(total, expected, rtol=1e-6)
    assert total > 0


def test_auxiliary_loss_has_a_gradient_for_the_router(base, x):
    model = lorasp_jax.adapt(base, [("0", SP)], rngs=nnx.Rngs(1))
    graphdef, adapters, frozen = lorasp_jax.split(model)

    def loss(adapters):
        model = nnx.merge(graphdef, adapters, frozen, copy=True)
        model(x)
        return lorasp_jax.auxiliary_loss(model)

    gradient = jax.jit(jax.grad(loss))(adapters)
    router = gradient["layers"][0]["adapter"].get_value()["router"]
    assert all(jnp.abs(leaf).max() > 0 for leaf in jax.tree.leaves(router))


def test_auxiliary_loss_is_zero_for_methods_without_losses(base, x):
    model = lorasp_jax.adapt(base, [("3", LoRA(rank=2))], rngs=nnx.Rngs(1))
    model(x)
    assert lorasp_jax.auxiliary_loss(model) == 0


def test_auxiliary_loss_needs_a_call_of_an_adapted_model(base, x):
    model = lorasp_jax.adapt(base, [("0", SP)], rngs=nnx.Rngs(1))
    with pytest.raises(ValueError, match="call the model first"):
        lorasp_jax.auxiliary_loss(model)


def test_auxiliary_loss_of_linen_variables(x):
    net = linen.Dense(6)
    adapter = lorasp_jax.LinenAdapter(net, [("", SP)])
    variables = adapter.attach(jax.random.key(1), net.init(jax.random.key(0), x), x)
    _, mutated = adapter.apply(variables, x, mutable=["intermediates"])
    losses = lorasp_jax.auxiliary_losses(lorasp_jax.collect_aux(mutated))
    expected = sum(getattr(WEIGHTS, name) * value for name, value in losses.items())
    np.testing.assert_allclose(lorasp_jax.auxiliary_loss(mutated), expected, rtol=1e-6)
