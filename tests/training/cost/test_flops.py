"""FLOPs compared with counts by hand and with XLA's own count."""

import jax
import jax.numpy as jnp
import pytest

from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.transformer.attention import attention
from lorasp_jax.training.cost import flops
from tests.models.random_models import observation, random_backbone

X, W = jnp.ones((6, 8)), jnp.ones((8, 5))
PRODUCT = 2 * 6 * 8 * 5


def layers(x, w):
    def body(x, w):
        return x @ w, None

    return jax.lax.scan(body, x, w)[0]


@pytest.mark.parametrize(
    ("function", "arguments", "expected"),
    [
        (jnp.matmul, (X, W), PRODUCT),
        (jax.jit(lambda x, w: jnp.tanh(x @ w)), (X, W), PRODUCT),
        (layers, (X, jnp.ones((4, 8, 8))), 4 * 2 * 6 * 8 * 8),
        (jax.grad(lambda w: (X @ w).sum()), (W,), PRODUCT),  # the sum itself is unused
        (jax.grad(lambda w: jnp.square(X @ w).sum()), (W,), 2 * PRODUCT),
        (lambda x, w: jax.lax.cond(x.sum() > 0, lambda: x @ w, lambda: x[:, :5]), (X, W), PRODUCT),
        (lambda x: jnp.einsum("bij,bkj->bik", x, x), (jnp.ones((3, 4, 5)),), 2 * 3 * 4 * 4 * 5),
    ],
)
def test_counted_by_hand(function, arguments, expected):
    assert flops.count(function, *arguments) == expected


def test_shapes_suffice():
    assert flops.count(jnp.matmul, jax.ShapeDtypeStruct((6, 8), "bfloat16"), W) == PRODUCT


def test_kernels_of_attention_count_as_their_products(monkeypatch):
    """As on a GPU, whose kernels hide them."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    q, kv = (jax.ShapeDtypeStruct((2, t, n, 16), "bfloat16") for t, n in ((5, 4), (37, 2)))

    def loss(q, k, v):
        return jnp.square(attention(q, k, v, jnp.ones((2, 5, 37), bool))).sum()

    assert "short_attention" in str(jax.make_jaxpr(loss)(q, kv, kv))
    assert flops.count(loss, q, kv, kv) == 4 * 2 * 5 * 4 * 37 * 16
    assert flops.count(jax.grad(loss, argnums=(0, 1, 2)), q, kv, kv) == 12 * 2 * 5 * 4 * 37 * 16


def test_a_backbone_agrees_with_xla():
    config = Pi0Config.nano()
    model, obs = random_backbone(config), observation(config, 2)
    actions = jnp.zeros((2, config.chunk, config.action_dim))

    def loss(model, obs):
        return model.loss(jax.random.key(0), obs, actions)[0].mean()

    xla = jax.jit(loss).lower(model, obs).cost_analysis()["flops"]
    assert (
        0.75 * xla < flops.count(loss, model, obs) < xla
    )  # XLA also counts elementwise operations


def test_utilization_needs_a_known_device():
    assert flops.utilization(1e12, 1.0) is None  # a CPU
