"""Attention over many keys is that over as many as it takes."""

import jax
import numpy as np
import pytest

from lorasp_jax.models.attention import MASKED, attention


@pytest.mark.parametrize("keys", [512, 600])
def test_attention_over_many_keys(keys):
    of = jax.random.split(jax.random.key(0), 4)
    q = jax.random.normal(of[0], (2, 5, 4, 8))
    k, v = (jax.random.normal(key, (2, keys, 2, 8)) for key in of[1:3])
    mask = jax.random.bernoulli(of[3], 0.5, (2, 5, keys))
    found = attention(q, k, v, mask)
    k, v = (np.repeat(a, 2, axis=2) for a in (k, v))
    logits = np.einsum("btnh,bsnh->bnts", q, k)
    weights = jax.nn.softmax(np.where(mask[:, None], logits, MASKED), axis=-1)
    expected = np.einsum("bnts,bsnh->btnh", weights, v).reshape(2, 5, -1)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
