"""Test the public code's gate against recorded ranks, and its losses against NumPy."""

import fractions

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.peft import LoRASPRelease
from lorasp_jax.peft import lora_sp_release as release
from tests import GOLDEN

pytestmark = pytest.mark.slow

D_IN, D_OUT, RANK = 12, 10, 16
METHOD = LoRASPRelease(rank=RANK)


X = 3 * jax.random.normal(jax.random.key(0), (2, 6, D_IN))


def arrays():
    """Parameters with U away from its initial value."""
    params = METHOD.init_params(jax.random.key(1), D_IN, D_OUT)
    params["bank"]["u"] = jax.random.normal(jax.random.key(2), (RANK, D_OUT))
    return params


def numpy_layer(params, x, scale, target=0.9):
    """y, scores, k and losses in NumPy float64, token by token."""
    w = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params)
    y, scores, masks = [], [], []
    for token in np.asarray(x, np.float64).reshape(-1, D_IN):
        s = token @ w["router"]["w1"]
        total, energy, mask = (s**2).sum(), 0.0, np.zeros(RANK, bool)
        for n, i in enumerate(np.argsort(-s, kind="stable")):
            energy += s[i] ** 2
            if n and energy > target * total:
                break
            mask[i] = True
        y.append(scale * (token @ w["bank"]["v"] * s * mask) @ w["bank"]["u"])
        scores.append(s)
        masks.append(mask)
    s, mask = np.array(scores), np.array(masks)
    gates = np.exp(np.where(mask, s, 0))
    gates /= gates.sum(1, keepdims=True)
    top_fraction = np.bincount(gates.argmax(1), minlength=RANK) / len(s)
    lse = np.clip(np.log(np.exp(s).sum(1)), -1, 10)
    losses = {
        "spectral": 1 - (s**2 * mask).sum() / (s**2).sum(),
        "balance": RANK * (top_fraction * gates.mean(0)).sum(),
        "z": np.log1p(lse).mean(),
    }
    return np.array(y), s, mask, losses


def test_recorded_ranks():
    golden = np.load(GOLDEN / "energy_gate_exact.npz")
    gate = jax.jit(release.release_gate)
    for eta, expected in zip(golden["etas"], golden["k_authors_rule"], strict=True):
        eta = float(fractions.Fraction(eta))
        if eta == 1:
            continue  # η = 1 keeps all, up to the rounding of a running sum
        actual = np.asarray(gate(golden["scores"], eta).sum(-1))
        energy = np.square(golden["scores"].astype(np.float64))
        ordered = np.cumsum(-np.sort(-energy, axis=-1), axis=-1)
        # Exact if the squares are in fp32 range and no energy share is within rounding of η.
        gap = np.abs(ordered / np.maximum(ordered[:, -1:], 1e-300) - eta).min(-1)
        exact = (gap > 1e-5) & (ordered[:, -1] > 1e-20) & (ordered[:, -1] < 1e30)
        assert exact.sum() > 400
        np.testing.assert_array_equal(actual[exact], expected[exact])


def test_kept_energy_stays_below_the_target():
    """With random signed scores, no token exceeds η, so the spectral loss exceeds 1 - η."""
    scores = jax.random.normal(jax.random.key(0), (4000, 128))
    mask = release.release_gate(scores, 0.9)
    energy = (scores**2 * mask).sum(-1) / (scores**2).sum(-1)
    assert 0.85 < energy.mean() < energy.max() <= 0.9
    assert release.release_losses(scores, mask, jnp.ones(4000, bool))["spectral"] > 0.1


def test_equals_numpy():
    params = arrays()
    delta, aux = jax.jit(METHOD.delta)(params, X)
    y, scores, mask, losses = numpy_layer(params, X, METHOD.scale)
    assert (scores < 0).any()
    np.testing.assert_allclose(delta.reshape(-1, D_OUT), y, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(aux.active_rank.ravel(), mask.sum(1))
    np.testing.assert_array_equal(aux.usage, mask.sum(0))
    energy = (scores**2 * mask).sum(1) / (scores**2).sum(1)
    np.testing.assert_allclose(aux.kept_energy.ravel(), energy, rtol=1e-5)
    for name, value in losses.items():
        assert aux.losses[name] == pytest.approx(value, rel=1e-4), name


def test_gradients_equal_numpy_differences():
    """The slope equals the central difference of the NumPy losses, with the same masks."""
    params = arrays()

    def total(params):
        y, aux = METHOD.delta(params, X)
        return jnp.sum(y**2) / 100 + sum(aux.losses.values())

    def numpy_total(params):
        y, _, mask, losses = numpy_layer(params, X, METHOD.scale)
        return (y**2).sum() / 100 + sum(losses.values()), mask

    gradient = jax.jit(jax.grad(total))(params)
    direction = jax.tree.map(lambda leaf: np.random.default_rng(0).normal(size=leaf.shape), params)
    ends = [
        jax.tree.map(lambda p, d: np.float64(p) + d, params, jax.tree.map(scale, direction))
        for scale in (lambda d: 1e-4 * d, lambda d: -1e-4 * d)
    ]
    (plus, mask), (minus, minus_mask) = map(numpy_total, ends)
    np.testing.assert_array_equal(mask, minus_mask)
    slope = sum(
        jax.tree.leaves(jax.tree.map(lambda g, d: float((g * d).sum()), gradient, direction))
    )
    assert slope == pytest.approx((plus - minus) / 2e-4, rel=2e-2)


def test_z_loss_is_minus_infinity_at_the_clip():
    """This flaw of the public code is kept for parity."""
    scores = jnp.full((1, 4), -9.0)
    losses = release.release_losses(scores, scores < 0, jnp.ones(1, bool))
    assert losses["z"] == -jnp.inf
