"""Padding of keys and queries does not change attention."""

import jax
import numpy as np
import pytest

from lorasp_jax.models.transformer.attention import MASKED, attention


@pytest.mark.parametrize("keys", [512, 600])
def test_attention_over_many_keys(keys):
    seeds = jax.random.split(jax.random.key(0), 4)
    q = jax.random.normal(seeds[0], (2, 5, 4, 8))
    k, v = (jax.random.normal(seed, (2, keys, 2, 8)) for seed in seeds[1:3])
    mask = jax.random.bernoulli(seeds[3], 0.5, (2, 5, keys))
    actual = attention(q, k, v, mask)
    k, v = (np.repeat(a, 2, axis=2) for a in (k, v))
    logits = np.einsum("btnh,bsnh->bnts", q, k)
    weights = jax.nn.softmax(np.where(mask[:, None], logits, MASKED), axis=-1)
    expected = np.einsum("bnts,bsnh->btnh", weights, v).reshape(2, 5, -1)
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-5)


def test_token_counts_are_padded_for_cudnn(monkeypatch):
    """XLA computes what cuDNN would: padded queries and keys do not change the result."""
    sizes, attend = [], jax.nn.dot_product_attention

    def in_xla(q, k, v, *args, implementation, **options):
        assert implementation == "cudnn"
        sizes.append((q.shape[1], k.shape[1]))
        return attend(q, k, v, *args, implementation="xla", **options)

    seeds = jax.random.split(jax.random.key(0), 4)
    q = jax.random.normal(seeds[0], (2, 131, 4, 64), "bfloat16") / 8
    k, v = (jax.random.normal(seed, (2, 141, 2, 64), "bfloat16") for seed in seeds[1:3])
    mask = jax.random.bernoulli(seeds[3], 0.5, (2, 131, 141))
    expected = attention(q, k, v, mask)
    monkeypatch.setattr(jax.nn, "dot_product_attention", in_xla)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    actual = attention(q, k, v, mask)
    assert sizes == [(136, 144)]
    np.testing.assert_allclose(actual.astype("f4"), expected.astype("f4"), atol=0.02)
