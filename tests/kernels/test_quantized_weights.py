"""Compare quantized kernels with their error bounds, their definitions and qwix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ndtri

from lorasp_jax.kernels.low_rank_matmul import Bottleneck, LowRankLayer, low_rank_matmul
from lorasp_jax.kernels.quantized_weights import KINDS, NF4, quantize_kernel
from tests import GOLDEN

GOLDEN = GOLDEN / "quantized_kernels.npz"
MAX_ERROR = {"float8": 16 / 448, "int8": 1 / 255, "nf4": (NF4[1] - NF4[0]) / 2}


def normal(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@jax.jit
def dequantize(kernel_q):
    return kernel_q.astype(jnp.float32)


def dequantized(kernel, kind):
    return np.asarray(dequantize(quantize_kernel(kernel, kind)))


def test_nf4_table():
    """QLoRA's construction: normal quantiles, 8 up to 0 and 9 from 0, scaled to [-1, 1]."""
    offset = (1 / 32 + 1 / 30) / 2
    below = ndtri(np.linspace(offset, 0.5, 8))
    above = -ndtri(np.linspace(offset, 0.5, 9))
    table = np.unique(np.concatenate([below / -below[0], above / above[0]]).round(6))
    np.testing.assert_allclose(table, NF4, atol=2e-4)
    assert len(NF4) == 16


@pytest.mark.parametrize("kind", ["int8", "nf4"])
def test_qwix(kind):
    """Codes and scales equal those of qwix 0.1.8, per column and in blocks of 64 inputs."""
    with np.load(GOLDEN) as golden:
        np.testing.assert_allclose(dequantized(golden["kernel"], kind), golden[kind], rtol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(256, 12), (100, 7), (5, 3), (2, 130, 6)])
def test_error_bound(kind, shape):
    kernel = normal(*shape)
    kernel_q = quantize_kernel(kernel, kind)
    error = np.abs(np.asarray(dequantize(kernel_q)) - kernel)
    assert (kernel_q.shape, kernel_q.dtype) == (shape, jnp.float32)
    block = 64 if kind == "nf4" else shape[-2]
    over = (-2, -1) if kind == "float8" else -2
    for start in range(0, shape[-2], block):
        rows = np.s_[..., start : start + block, :]
        largest = np.abs(kernel[rows]).max(over, keepdims=True)
        assert (error[rows] <= 1.0001 * MAX_ERROR[kind] * largest).all()


def test_float8_rounds_each_weight_relative_to_its_size():
    """Small weights lose no more than large ones, down to 1/28,000 of the largest."""
    kernel = normal(2, 64, 9) * np.array([1e-3, 1e3])[:, None, None]
    kernel[:, 0] *= 100
    error = np.abs(dequantized(kernel, "float8") - kernel)
    steps = np.abs(kernel).max((1, 2), keepdims=True) / 448 * 2**-10
    assert (error <= np.maximum(np.abs(kernel) / 16, steps) * 1.0001).all()
    assert (error > np.abs(kernel) / 20).any()


@pytest.mark.parametrize("kind", KINDS)
def test_representable_values_are_exact(kind):
    float8 = np.arange(256, dtype=np.uint8).view(jnp.float8_e4m3fn).astype(np.float32) / 448
    tables = {"float8": float8[np.isfinite(float8)], "int8": np.arange(-127, 128) / 127.5}
    table = tables.get(kind, np.array(NF4))
    kernel = np.random.default_rng(0).choice(table, (64, 9)).astype(np.float32)
    kernel[0] = 1.0
    kernel[:, 3] = 0.0
    np.testing.assert_allclose(dequantized(kernel, kind)[1:], kernel[1:], atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_stack_equals_its_layers(kind):
    kernel = normal(2, 3, 70, 5)
    stack = quantize_kernel(kernel, kind)
    layers = [[dequantized(matrix, kind) for matrix in row] for row in kernel]
    np.testing.assert_array_equal(dequantize(stack), layers)

    @jax.jit
    def half(stack):
        flat = stack.reshape(-1, 70, 5)
        scanned = jax.lax.scan(lambda _, k: (None, k.astype(jnp.bfloat16)), None, flat)[1]
        return flat, flat.astype(jnp.bfloat16), scanned

    flat, expected, scanned = half(stack)
    assert flat.shape == (6, 70, 5)
    np.testing.assert_array_equal(dequantize(flat)[4], layers[1][1])
    assert scanned.dtype == jnp.bfloat16
    np.testing.assert_array_equal(scanned, expected)


class Identity(Bottleneck):
    def bottleneck(self, params, rows, token_mask):
        del params, token_mask
        return rows, ()


def low_rank(x, kernel, p, u):
    """Compute x W + (x P) U."""
    layers = [LowRankLayer((), kernel, p, u)]
    return low_rank_matmul(Identity(), x.dtype, layers, x, None)[0][0]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(6, 10), (10, 6)])
def test_values_and_gradients_equal_the_dequantized_kernel(kind, shape):
    kernel_q = quantize_kernel(normal(*shape), kind)
    x, p, u = normal(4, shape[0], seed=1), normal(shape[0], 3, seed=2), normal(3, shape[1], seed=3)

    def loss(x, p, u, kernel):
        return jnp.sum(jnp.sin(low_rank(x, kernel, p, u)))

    run = jax.jit(jax.value_and_grad(loss, (0, 1, 2)))
    actual, expected = run(x, p, u, kernel_q), run(x, p, u, dequantize(kernel_q))
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_residuals_contain_only_the_codes(kind):
    kernel_q = quantize_kernel(normal(64, 64), kind)
    x, p, u = normal(2, 64), normal(64, 1), normal(1, 64)
    vjp = jax.eval_shape(lambda *a: jax.vjp(low_rank, *a)[1], x, kernel_q, p, u)
    residual_bytes = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(vjp))
    assert residual_bytes <= kernel_q.nbytes + x.nbytes + p.nbytes + u.nbytes + 2 * 4  # z [2, 1]


def test_invalid_input():
    with pytest.raises(ValueError, match="NaN or infinite values"):
        quantize_kernel(jnp.array([[1.0, jnp.nan]]), "int8")
