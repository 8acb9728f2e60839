"""Normalized banks: eq. (4) for arbitrary U and V."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.peft import LoRASP
from lorasp_jax.peft.lora_sp.bank import normalized_bank
from lorasp_jax.peft.lora_sp.router import router_scores

pytestmark = pytest.mark.slow

METHOD = LoRASP(rank=8, hidden_width=4, energy_target=0.7, normalized_bank=True)


def arrays(d_in, d_out):
    """Parameters whose directions are far from orthogonal, with a large common component."""
    params, _ = METHOD.init(jax.random.key(1), jax.ShapeDtypeStruct((d_in, d_out), jnp.float32))
    u, v, w2 = (
        1 + jax.random.normal(jax.random.key(i), shape)
        for i, shape in enumerate([(8, d_out), (d_in, 8), (4, 8)])
    )
    router = params["router"] | {"w2": w2}
    return {"bank": {"u": u, "v": v, "gain": jnp.float32(0.3)}, "router": router}


def errors(method, params, x):
    """‖ΔW(x) - ΔW_k(x)‖ / ‖ΔW(x)‖ of one token, and √(1 - E_k) from the layer's aux."""
    scores, _ = router_scores(params["router"], x @ params["router"]["w1"], "gelu")
    bank = normalized_bank(params["bank"]) if method.normalized_bank else params["bank"]
    delta, aux = method.delta(params, x)
    kept = jnp.isin(jnp.arange(8), jnp.argsort(-scores)[: int(aux.active_rank)])
    full, pruned = (
        bank["v"] @ jnp.diag(jnp.where(mask, scores, 0)) @ bank["u"] for mask in (True, kept)
    )
    np.testing.assert_allclose(delta, method.scale * x @ pruned, rtol=1e-4, atol=1e-5)
    norm = jnp.linalg.norm
    return float(norm(full - pruned) / norm(full)), float(jnp.sqrt(1 - aux.kept_energy))


@pytest.mark.parametrize("shape", [(24, 10), (10, 24), (8, 8), (9, 3)])
def test_eq_4_holds(shape):
    params = arrays(*shape)
    for token in jax.random.normal(jax.random.key(9), (3, shape[0])):
        actual, expected = errors(METHOD, params, token)
        assert 0.05 < expected < 0.6
        assert actual == pytest.approx(expected, rel=1e-4)


def test_eq_4_does_not_hold_for_a_raw_bank():
    raw = dataclasses.replace(METHOD, normalized_bank=False)
    actual, expected = errors(raw, arrays(24, 10), jax.random.normal(jax.random.key(9), (24,)))
    assert actual != pytest.approx(expected, rel=0.1)


def test_initially_zero_and_every_array_gets_a_gradient():
    params, _ = METHOD.init(jax.random.key(1), jax.ShapeDtypeStruct((24, 10), jnp.float32))
    x = jax.random.normal(jax.random.key(2), (5, 24))

    def loss(params):
        return jnp.sum((METHOD.delta(params, x)[0] - 1) ** 2)

    np.testing.assert_array_equal(METHOD.delta(params, x)[0], 0)
    initial_grads = jax.grad(loss)(params)
    assert float(jnp.abs(initial_grads["bank"]["gain"])) > 0.1
    moved = params | {"bank": params["bank"] | {"gain": jnp.float32(0.1)}}
    for leaf in jax.tree.leaves(jax.jit(jax.grad(loss))(moved)):
        assert np.isfinite(leaf).all()
        assert jnp.abs(leaf).max() > 0


def test_continuous_where_qr_flips_signs():
    """Flipping the sign of the entry that sets LAPACK's sign has only a small effect."""
    bank = arrays(24, 10)["bank"]
    ends = [
        normalized_bank(bank | {"v": bank["v"].at[0, 0].set(entry)})["v"] for entry in (-1e-4, 1e-4)
    ]
    np.testing.assert_allclose(*ends, atol=1e-3)


def test_rank_must_not_exceed_the_wider_side():
    with pytest.raises(ValueError, match=r"rank <= max\(I, O\), got rank 8 for a kernel \[6, 7\]"):
        METHOD.init(jax.random.key(0), jnp.zeros((6, 7)))
