"""Values and gradients of the kernels are those of `attention`, which XLA compiles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.kernels.blocks import Launch
from lorasp_jax.kernels.short_attention import MAX_KEYS, short_attention
from lorasp_jax.models.transformer.attention import attention
from tests.jaxprs import target

LAUNCHES = Launch(rows=16, keys=32, warps=4), Launch(rows=32, keys=16, warps=4)


def inputs(tokens, keys, heads, kv_heads, dtype=jnp.bfloat16, *, masked=True, size=16):
    """Return q, k, v, a mask with fully masked rows, and the gradient of the result."""
    rng = np.random.default_rng(0)
    shapes = [(2, tokens, heads, size), *[(2, keys, kv_heads, size)] * 2, (2, tokens, heads * size)]
    q, k, v, dy = (rng.normal(size=shape) for shape in shapes)
    mask = rng.random((2, tokens, keys)) < 0.5
    mask[:, 1] = False
    q, k, v, dy = (jax.device_put(a.astype(dtype)) for a in (q / 2, k, v, dy))
    return q, k, v, mask if masked else None, dy


def kernel(q, k, v, mask):
    interpret = jax.default_backend() != "gpu"
    return short_attention(q, k, v, mask, launches=LAUNCHES, interpret=interpret)


@jax.jit(static_argnums=0)
def run(function, q, k, v, mask, dy):
    """Return the result and the gradients of q, k and v."""
    y, vjp = jax.vjp(lambda *arrays: function(*arrays, mask), q, k, v)
    return y, *vjp(dy)


def assert_close(actual, expected, tolerance):
    for a, b in zip(actual, expected, strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        a, b = np.float32(a), np.float32(b)
        assert np.linalg.norm(a - b) <= tolerance * np.linalg.norm(b)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tokens", "keys", "heads", "kv_heads", "dtype", "masked"),
    [
        (11, 37, 6, 2, jnp.bfloat16, True),  # two blocks of rows, keys in several matmuls
        (11, 37, 6, 2, jnp.float16, True),
        (16, 32, 4, 4, jnp.bfloat16, False),  # nothing padded
        (5, 21, 4, 4, jnp.bfloat16, False),
        (16, 138, 8, 1, jnp.bfloat16, True),
        (3, MAX_KEYS, 2, 1, jnp.bfloat16, True),
        (2, 1, 2, 1, jnp.bfloat16, True),
    ],
)
def test_equals_attention(tokens, keys, heads, kv_heads, dtype, masked):
    arrays = inputs(tokens, keys, heads, kv_heads, dtype, masked=masked)
    actual, expected = run(kernel, *arrays), run(attention, *arrays)
    assert_close(actual, expected, 1e-2 if dtype == jnp.bfloat16 else 2e-3)
    if masked:
        y, dq, *_ = actual
        mean = arrays[2].astype(jnp.float32).mean(1).repeat(heads // kv_heads, axis=1)
        np.testing.assert_allclose(y[:, 1].astype("f4"), mean.reshape(2, -1), atol=0.02)
        np.testing.assert_array_equal(dq[:, 1].astype("f4"), 0)


@pytest.mark.skipif(jax.default_backend() == "gpu", reason="the GPU would use TF32")
@pytest.mark.parametrize("offset", [0, pytest.param(300, marks=pytest.mark.slow)])
def test_logits_of_any_size(offset):
    """In fp32 the results agree to rounding errors, however large the logits."""
    q, k, v, mask, dy = inputs(7, 21, 4, 1, jnp.float32)
    arrays = q, k + offset * (np.arange(16, dtype="f") == 0), v, mask, dy
    assert_close(run(kernel, *arrays), run(attention, *arrays), 1e-5 if offset == 0 else 1e-3)


@pytest.mark.slow
def test_two_runs_give_the_same_bits():
    arrays = inputs(40, 70, 8, 1)
    first, second = run(kernel, *arrays), run(kernel, *arrays)
    jax.tree.map(np.testing.assert_array_equal, first, second)


@pytest.mark.slow
def test_vmap_equals_a_loop():
    q, *others = inputs(5, 21, 4, 2)
    pairs = [(q, *others), (q * 2, *others)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *pairs)
    actual = jax.vmap(lambda *arrays: run(kernel, *arrays))(*stacked)
    expected = [run(kernel, *arrays) for arrays in pairs]
    assert_close(actual, jax.tree.map(lambda *leaves: jnp.stack(leaves), *expected), 1e-3)


@pytest.mark.slow
def test_layers_in_a_scan_with_remat():
    q, k, v, mask, dy = inputs(5, 5, 4, 2)

    def layers(attend):
        def layer(x, _):
            return x + attend(x, k, v, mask).reshape(x.shape), None

        def loss(q):
            x, _ = jax.lax.scan(jax.checkpoint(layer), q, length=2)
            return (x.reshape(dy.shape) * dy).sum()

        return jax.jit(jax.grad(loss))(q)

    assert_close([layers(kernel)], [layers(attention)], 2e-2)


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
@pytest.mark.parametrize(
    ("tokens", "keys", "heads", "kv_heads", "size", "masked"),
    [
        (138, 138, 8, 1, 32, True),
        (64, 64, 4, 4, 64, False),
        (11, 149, 8, 1, 32, True),
        pytest.param(43, 43, 6, 2, 32, True, marks=pytest.mark.slow),
        pytest.param(128, MAX_KEYS, 2, 1, 128, True, marks=pytest.mark.slow),
    ],
)
def test_lowers_for_a_gpu_without_arrays_of_all_logits(tokens, keys, heads, kv_heads, size, masked):
    arrays = inputs(tokens, keys, heads, kv_heads, masked=masked, size=size)
    with target("cuda", "NVIDIA H200"):
        traced = jax.jit(lambda *arrays: run(short_attention, *arrays)).trace(*arrays)
        text = traced.lower(lowering_platforms=("cuda",)).as_text()
    assert text.count("custom_call @__gpu$xla.gpu.triton") == 2
    assert max(sizes(traced.jaxpr.jaxpr)) <= max(array.size for array in jax.tree.leaves(arrays))


def sizes(jaxpr):
    """Yield the size of every array that is computed outside kernels."""
    for equation in jaxpr.eqns:
        yield from (v.aval.size for v in equation.outvars)
        if equation.primitive.name != "pallas_call":
            inner = [getattr(value, "jaxpr", value) for value in equation.params.values()]
            for value in inner:
                yield from sizes(value) if hasattr(value, "eqns") else ()
