"""The fast path computes what the equations say, and so do its gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.peft import LoRASP
from lorasp_jax.peft.lora_sp import reference

TOKENS, D_IN, D_OUT = 48, 24, 20


def drawn(method, spread):
    """Parameters with U and W2 far from their start, so that scores differ."""
    params = method.init_params(jax.random.key(0), D_IN, D_OUT)
    u, w2 = (
        jax.random.normal(jax.random.key(i), (s, o))
        for i, s, o in ((1, method.rank, D_OUT), (2, method.hidden_width, method.rank))
    )
    params["bank"]["u"], params["router"]["w2"] = u / 8, spread * w2
    return params


@pytest.mark.parametrize("energy_target", [0.5, 0.9, 0.99])
@pytest.mark.parametrize("spread", [0.1, 1.0])
def test_the_fast_path_is_the_paper(energy_target, spread):
    method = LoRASP(rank=32, hidden_width=16, energy_target=energy_target)
    params = drawn(method, spread)
    x = jax.random.normal(jax.random.key(3), (TOKENS, D_IN))

    def total(function):
        def loss(params, x):
            delta, losses = function(params, x)
            return jnp.sum(jnp.sin(delta)) + sum(losses.values()), (delta, losses)

        return jax.jit(jax.value_and_grad(loss, argnums=(0, 1), has_aux=True))(params, x)

    def fast(params, x):
        delta, aux = method.delta(params, x)
        return delta, dict(aux.losses)

    found = total(fast)
    expected = total(lambda params, x: reference.lora_sp(params, x, energy_target, method.scale))
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        np.testing.assert_allclose(one, other, rtol=2e-4, atol=2e-5 * float(jnp.abs(other).max()))


def test_the_gate_keeps_the_fewest():
    scores = jnp.array([[3.0, 1.0, 2.0, 0.0]])  # energy 9, 1, 4, 0 of 14
    for target, kept in ((0.6, [1, 0, 0, 0]), (0.9, [1, 0, 1, 0]), (0.93, [1, 1, 1, 0])):
        np.testing.assert_array_equal(reference.energy_gate(scores, target)[0], kept)
