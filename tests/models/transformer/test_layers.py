"""The order in which a prefix's tokens are processed."""

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.models.transformer.layers import valid_first

VALID = np.array([[0, 1, 0, 0, 1, 1], [1, 1, 1, 1, 1, 1], [0, 0, 0, 0, 0, 1], [0] * 6], bool)
ORDER = np.array([[1, 4, 5, 0, 2, 3], [0, 1, 2, 3, 4, 5], [5, 0, 1, 2, 3, 4], [0, 1, 2, 3, 4, 5]])
X = np.random.default_rng(0).normal(size=(*VALID.shape, 2)).astype(np.float32)


def test_valid_tokens_come_first_in_their_order():
    x, valid = jax.jit(valid_first)(X, VALID)
    np.testing.assert_array_equal(x, np.take_along_axis(X, ORDER[..., None], axis=1))
    np.testing.assert_array_equal(valid, np.take_along_axis(VALID, ORDER, axis=1))
    assert (np.diff(np.int32(valid)) <= 0).all()


def test_gradients_return_to_their_tokens():
    weights = jnp.asarray(np.random.default_rng(1).normal(size=X.shape).astype(np.float32))
    actual = jax.grad(lambda x: (weights * valid_first(x, VALID)[0]).sum())(X)
    expected = np.zeros_like(X)
    np.put_along_axis(expected, ORDER[..., None], weights, axis=1)
    np.testing.assert_array_equal(actual, expected)
