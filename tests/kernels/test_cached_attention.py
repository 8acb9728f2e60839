import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.kernels.cached_attention import Launch, cached_attention
from lorasp_jax.models.transformer import attention

BATCH, TOKENS, KV_HEADS, GROUP, DIM = 2, 5, 2, 3, 16
LAUNCHES = {
    "one_program": Launch(rows=16, keys=16, splits=1, warps=1),
    "splits": Launch(rows=16, keys=16, splits=2, warps=1),
    "more_splits_than_blocks": Launch(rows=16, keys=16, splits=9, warps=1),
    "one_block": Launch(rows=32, keys=64, splits=1, warps=1),
}


def inputs(cached, own, dtype=jnp.float32):
    """q, own keys and values, cached ones, and a mask that hides some keys from some queries."""
    keys = jax.random.split(jax.random.key(0), 6)
    draw = lambda key, *shape: jax.random.normal(key, (BATCH, *shape)).astype(dtype)  # noqa: E731
    q = draw(keys[0], TOKENS, KV_HEADS * GROUP, DIM)
    own_pair, cache = (
        tuple(draw(key, count, KV_HEADS, DIM) for key in jax.random.split(k)) if count else None
        for k, count in zip(keys[1:3], (own, cached), strict=True)
    )
    mask = jax.random.bernoulli(keys[3], 0.7, (BATCH, TOKENS, cached + own))
    return q, own_pair, cache, mask.at[:, :, -1].set(True)


@pytest.mark.parametrize("launch", LAUNCHES.values(), ids=LAUNCHES)
@pytest.mark.parametrize(("cached", "own"), [(20, TOKENS), (32, TOKENS), (37, 0), (32, 0)])
def test_matches_attention_over_concatenated_keys(cached, own, launch):
    arrays = inputs(cached, own)
    actual = cached_attention(*arrays, launch=launch, interpret=True)
    q, own_pair, cache, mask = arrays
    pairs = (cache, None) if own_pair is None else (own_pair, cache)
    np.testing.assert_allclose(actual, attention._concatenated(q, *pairs, mask), atol=1e-5)


def test_a_query_without_keys_attends_to_all_of_them_equally():
    q, own, cache, mask = inputs(20, 5)
    y = cached_attention(
        q, own, cache, mask.at[0, 1].set(False), launch=LAUNCHES["splits"], interpret=True
    )
    values = jnp.concatenate([cache[1], own[1]], axis=1)[0].mean(0)
    expected = jnp.repeat(values, GROUP, axis=0).reshape(-1)
    np.testing.assert_allclose(y[0, 1], expected, atol=1e-6)


def test_large_logits_do_not_overflow():
    q, own, cache, mask = inputs(20, 5)
    call = functools.partial(cached_attention, launch=LAUNCHES["splits"], interpret=True)
    y = call(1e4 * q, own, cache, mask)
    expected = attention.attention(1e4 * q, *own, mask, cache)
    np.testing.assert_allclose(y, expected, atol=1e-5)


@pytest.fixture
def interpreted(monkeypatch):
    """Let `attention` choose the kernel as on a GPU, and interpret it."""
    call = functools.partial(cached_attention, launch=LAUNCHES["splits"], interpret=True)
    calls = []
    monkeypatch.setattr(attention, "platform", lambda: "gpu")
    monkeypatch.setattr(attention, "cached_attention", lambda *a: calls.append(1) or call(*a))
    monkeypatch.setattr(attention, "MAX_KEYS", 0)  # instead of the kernel for few keys
    return calls


def test_attention_uses_the_kernel_only_without_gradient(interpreted):
    q, (k, v), cache, mask = inputs(20, 5, jnp.bfloat16)
    run = lambda q: attention.attention(q, k, v, mask, cache).astype(jnp.float32)  # noqa: E731
    plain = lambda q: attention._concatenated(q, (k, v), cache, mask).astype(jnp.float32)  # noqa: E731
    np.testing.assert_allclose(run(q), plain(q), atol=0.02)
    assert len(interpreted) == 1
    actual, expected = (jax.grad(lambda q, f=f: jnp.sin(f(q)).sum())(q) for f in (run, plain))
    np.testing.assert_array_equal(actual, expected)
    assert len(interpreted) == 1


def test_a_batch_can_be_mapped(interpreted):
    q, (k, v), cache, mask = inputs(20, 5, jnp.bfloat16)
    expected = attention.attention(q, k, v, mask, cache)
    one = lambda *arrays: attention.attention(*(a[None] for a in arrays[:4]), arrays[4])[0]  # noqa: E731
    lifted = jax.tree.map(lambda a: a[:, None], cache)
    actual = jax.vmap(one)(q, k, v, mask, lifted)
    np.testing.assert_array_equal(actual, expected)
