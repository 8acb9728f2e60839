"""Score functions, padding and usage."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.peft import LoRASP
from lorasp_jax.peft.lora_sp import router as routing

pytestmark = pytest.mark.slow

D_IN, D_OUT, RANK = 6, 5, 16
MASK = jnp.arange(7)[None] < jnp.array([[3], [7], [0]])


@pytest.fixture
def x():
    return jax.random.normal(jax.random.key(0), (3, 7, D_IN))


def arrays(method, spread=1.0):
    kernel = jax.ShapeDtypeStruct((D_IN, D_OUT), jnp.float32)
    params, _ = method.init(jax.random.key(1), kernel)
    params["bank"]["u"] = jax.random.normal(jax.random.key(2), (RANK, D_OUT))
    w2 = params["router"]["w2"]
    params["router"]["w2"] = w2 + spread * jax.random.normal(jax.random.key(3), w2.shape)
    return params


def scores_of(method, params, x):
    router = params["router"]
    return routing.router_scores(router, x @ router["w1"], method.router)


@pytest.mark.parametrize("name", ["gelu", "gelu_relu", "gelu_softmax"])
def test_score_functions(name, x):
    """Initial scores are 1; scores are the router's function of the logits."""
    method = LoRASP(rank=RANK, router=name)
    scores, _ = scores_of(method, arrays(method, 0), x)
    np.testing.assert_allclose(scores, 1, atol=0.1)
    params = arrays(method)
    scores, logits = map(np.asarray, scores_of(method, params, x))
    expected = {
        "gelu": np.log1p(np.exp(logits)),
        "gelu_relu": np.maximum(logits, 0),
        "gelu_softmax": RANK * np.exp(logits) / np.exp(logits).sum(-1, keepdims=True),
    }[name]
    np.testing.assert_allclose(scores, expected, rtol=1e-5, atol=1e-6)
    delta, aux = jax.jit(method.delta)(params, x)
    kept = scores * np.asarray(
        jnp.stack([_smallest_set(s, 0.9) for s in scores.reshape(-1, RANK)])
    ).reshape(scores.shape)
    expected = method.scale * (np.asarray(x @ params["bank"]["v"]) * kept) @ params["bank"]["u"]
    np.testing.assert_allclose(delta, expected, rtol=1e-4, atol=1e-4)
    assert 0 < aux.mean_active_rank() < RANK


def _smallest_set(scores, target):
    """Eq. (12) in NumPy: mask of the smallest set that holds a fraction `target` of the energy."""
    order = np.argsort(-scores, kind="stable")
    energy = np.cumsum(np.float64(scores[order]) ** 2)
    k = int(np.searchsorted(energy, target * energy[-1])) + 1
    return np.isin(np.arange(len(scores)), order[:k])


@pytest.mark.parametrize("name", ["gelu", "gelu_relu", "gelu_softmax"])
def test_padding_is_ignored(name, x):
    """Losses, usage, outputs of valid tokens and gradients do not depend on padding."""
    method = LoRASP(rank=RANK, router=name)
    params = arrays(method)

    @jax.jit
    def run(x):
        def loss(params):
            y, aux = method.delta(params, x, token_mask=MASK)
            y = jnp.where(MASK[..., None], y, 0)
            return y.sum() + sum(aux.losses.values()), (y, aux.losses, aux.usage)

        return jax.value_and_grad(loss, has_aux=True)(params)

    clean, padded = run(x), run(jnp.where(MASK[..., None], x, 1e3))
    for a, b in zip(jax.tree.leaves(clean), jax.tree.leaves(padded), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


def test_usage_counts_valid_tokens(x):
    method = LoRASP(rank=RANK, energy_target=0.7)
    params = arrays(method)
    _, aux = method.delta(params, x, token_mask=MASK)
    scores = np.asarray(scores_of(method, params, x)[0])[np.asarray(MASK)]
    expected = sum(_smallest_set(s, 0.7).astype(int) for s in scores)
    np.testing.assert_array_equal(aux.usage, expected)
