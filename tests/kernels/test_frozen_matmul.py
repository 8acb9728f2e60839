"""Products in float8: their rounding, where they are used, and that only their factors are."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.dense import dense
from lorasp_jax.kernels import frozen_matmul as fm
from lorasp_jax.kernels.quantized_weights import quantize_kernel
from lorasp_jax.peft import LoRASP
from lorasp_jax.training.distributed import mesh as meshes
from tests.jaxprs import equations, target

METHOD = LoRASP(rank=8)

pytestmark = pytest.mark.filterwarnings(
    "ignore:The Pallas Triton backend is deprecated:DeprecationWarning"
)


def normal(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.fixture
def on_hopper(monkeypatch):
    """Multiply in float8 here as well, whatever the shape, though this device emulates it."""
    monkeypatch.setattr(fm, "multiplies_float8", lambda: True)
    monkeypatch.setattr(fm, "MIN_WIDTH", 0)
    monkeypatch.setattr(fm, "MIN_PRODUCTS", 0)
    jax.clear_caches()
    yield
    jax.clear_caches()


def relative_error(found, expected):
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def test_errors_are_those_of_rounding(on_hopper):
    """Both factors are rounded, e4m3 to 2.65 % and e5m2 to 5.3 %; a stray scale would show."""
    kernel, x = np.float32(0.03) * normal(0, 256, 384), 7 * normal(1, 64, 256)
    g = np.float32(1e-6) * normal(2, 64, 384)

    @jax.jit
    def run(x, kernel, g):
        y, vjp = jax.vjp(lambda x: fm.frozen_matmul(x, kernel), x)
        return y, vjp(g)[0]

    y, dx = run(x, quantize_kernel(kernel, "float8"), g)
    assert relative_error(y, x @ kernel) == pytest.approx(0.037, rel=0.05)
    assert relative_error(dx, g @ kernel.T) == pytest.approx(0.059, rel=0.05)


@functools.partial(jax.jit, static_argnums=1)
def rounded(x, dtype):
    codes, scale = fm.encode(x, dtype)
    return codes.astype(jnp.float32) * scale


@pytest.mark.parametrize("dtype", ["float8_e4m3fn", "float8_e5m2"])
def test_scaling_reaches_the_largest_code_and_no_further(dtype):
    largest = float(jnp.finfo(dtype).max)
    for size in (1e-30, 1e-6, 1.0, 3e38):
        x = np.array([-1, 0.5, 2**-8, 0.0], np.float32) * np.float32(size)
        np.testing.assert_allclose(rounded(x, dtype), x, rtol=1e-6)
    codes = rounded(np.array([1, 1.3], np.float32) * np.float32(largest / 1.3), dtype)
    np.testing.assert_allclose(codes, np.array([1, 1.3]) * largest / 1.3, rtol=0.08)
    np.testing.assert_array_equal(rounded(np.zeros(2, np.float32), dtype), 0)
    tiny = np.array([1, -0.5, 0], np.float32) * np.float32(1e-36)
    np.testing.assert_allclose(rounded(tiny, dtype), tiny, rtol=0.08)
    assert np.isnan(
        rounded(np.array([1, np.nan], np.float32), dtype)
    ).all()  # the guard must see it
    assert np.isnan(rounded(np.array([1, np.inf], np.float32), dtype)).any()


@pytest.mark.parametrize("method", [None, METHOD])
def test_codes_are_the_only_difference(on_hopper, method):
    """An adapted layer in float8 is the layer on rounded factors: gradients, aux and all."""
    kernel, x = quantize_kernel(normal(0, 24, 16), "float8"), normal(1, 8, 24)
    x8, zeros = rounded(x, jnp.float8_e4m3fn), np.zeros((24, 16), np.float32)

    @jax.jit
    def run(x, kernel):
        params = method and method.init(jax.random.key(2), zeros)[0]
        y, vjp = jax.vjp(lambda x: dense(x, kernel, None, params, method)[0], x)
        return y, *vjp(jnp.ones_like(y))

    (y, gradient), (expected, of_adapter) = run(x, kernel), run(x, zeros)
    w = np.asarray(jax.jit(lambda kernel: kernel.astype(jnp.float32))(kernel))
    np.testing.assert_allclose(y, x8 @ w + expected, atol=1e-5)
    np.testing.assert_allclose(gradient, np.ones((8, 16)) @ w.T + of_adapter, atol=1e-5)


def traced(tokens, d_in, d_out, kind="float8", platform="cuda"):
    """An adapted layer, traced forward and backward."""
    kernel = jax.eval_shape(lambda: quantize_kernel(jnp.zeros((d_in, d_out)), kind))
    params, _ = jax.eval_shape(lambda: METHOD.init(jax.random.key(0), jnp.zeros((d_in, d_out))))
    x = jax.ShapeDtypeStruct((tokens, d_in), jnp.bfloat16)

    def loss(params, x, kernel):
        return METHOD.apply(params, x, kernel)[0].astype(jnp.float32).sum()

    with target(platform, "NVIDIA H200"):
        return jax.jit(jax.value_and_grad(loss, (0, 1))).trace(params, x, kernel)


def formats(*shape, **options):
    """Float8 formats that an adapted layer rounds to, forward and backward, once each."""
    converts = [
        str(equation.params["new_dtype"])
        for equation in equations(traced(*shape, **options).jaxpr.jaxpr)
        if equation.primitive.name == "convert_element_type"
    ]
    return sorted(name for name in converts if "float8" in name)


def test_used_where_it_pays():
    """On NVIDIA GPUs, for many tokens and a wide result; each pass decides for itself."""
    both = ["float8_e4m3fn", "float8_e5m2"]
    assert formats(26112, 2048, 16384) == formats(8192, 2048, 2048) == both
    assert formats(26112, 4096, 512) == both[1:]
    assert formats(26112, 512, 4096) == both[:1]
    assert formats(1024, 2048, 2048) == []
    assert formats(16, 2048, 16384) == both  # dequantizing a large W takes longer
    assert formats(26112, 2048, 16384, kind="int8") == []
    assert formats(26112, 2048, 16384, platform="cpu") == []
    assert formats(26112, 2048, 16384, platform="rocm") == []


def test_the_forward_product_transposes_nothing_and_is_not_merged():
    """cuBLASLt wants both factors as [rows, summed]. XLA merges products of one and the same x8."""
    text = traced(16, 2048, 16384).lower(lowering_platforms=("cuda",)).as_text()
    x8, w8 = "tensor<16x2048xf8E4M3FN>", "tensor<16384x2048xf8E4M3FN>"
    assert re.search(rf"contracting_dims = \[1\] x \[1\].* \({x8}, {w8}\)", text)
    assert re.search(rf"optimization_barrier .*{x8}, {w8}", text)


def test_each_device_scales_its_own_rows(on_hopper):
    """One scale for all rows would be a collective before each product."""
    kernel = quantize_kernel(normal(0, 16, 24), "float8")
    x = (
        normal(1, 8, 4, 16) * np.float32(10) ** np.arange(8)[:, None, None]
    )  # of very different sizes
    x = x.astype(np.float32)
    mesh = meshes.make_mesh()
    rows = meshes.batch_sharding(mesh)

    def forward_and_backward(x):
        y, vjp = jax.vjp(lambda x: fm.frozen_matmul(x, kernel), x)
        return y, *vjp(y)

    run = jax.jit(forward_and_backward, in_shardings=rows, out_shardings=rows).lower(x).compile()
    assert "all-" not in (run.as_text() or "")
    found = run(jax.device_put(x, rows))
    expected = jax.jit(jax.vmap(forward_and_backward))(x)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5)
