"""Test that the router's fast nonlinearities equal the standard ones."""

import jax
import numpy as np

from lorasp_jax.peft.lora_sp.router import gelu, softplus


def test_softplus_and_its_gradient():
    x = np.linspace(-80, 40, 200_001, dtype=np.float32)
    x64 = x.astype(np.float64)
    np.testing.assert_allclose(softplus(x), np.logaddexp(x64, 0), rtol=1e-6)
    gradient = jax.vmap(jax.grad(softplus))(x)
    np.testing.assert_allclose(gradient, 1 / (1 + np.exp(-x64)), rtol=1e-6)


def test_gelu_and_its_gradient():
    x = np.linspace(-9, 9, 10_001, dtype=np.float32)
    x64, root = x.astype(np.float64), np.sqrt(2 / np.pi)
    tanh = np.tanh(root * (x64 + 0.044715 * x64**3))
    np.testing.assert_allclose(gelu(x), x64 * (1 + tanh) / 2, atol=5e-6)
    np.testing.assert_allclose(gelu(x), jax.nn.gelu(x), atol=5e-6)
    gradient = (1 + tanh + x64 * (1 - tanh**2) * root * (1 + 3 * 0.044715 * x64**2)) / 2
    np.testing.assert_allclose(jax.vmap(jax.grad(gelu))(x), gradient, atol=1e-5)


def test_softplus_at_extreme_inputs():
    x = np.array([-np.inf, -1e30, 1e30, np.inf], np.float32)
    np.testing.assert_array_equal(softplus(x), [0, 0, np.float32(1e30), np.inf])
    np.testing.assert_array_equal(jax.vmap(jax.grad(softplus))(x), [0, 0, 1, 1])
