"""Padding of keys and queries does not change attention, nor do the kernels for few keys."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from lorasp_jax.kernels.short_attention import short_attention
from lorasp_jax.models import pi0, smolvla
from lorasp_jax.models.transformer import attention as module
from lorasp_jax.models.transformer.attention import MASKED, attention
from tests.jaxprs import equations, target
from tests.models.random_models import observation, random_backbone

ALLOW_TRITON = pytest.mark.filterwarnings(
    "ignore:The Pallas Triton backend is deprecated:DeprecationWarning"
)


def shapes(keys, head_dim, dtype="bfloat16", *, tokens=11, heads=4, kv_heads=2):
    """Return the shapes of q, k, v and the mask."""
    q = jax.ShapeDtypeStruct((2, tokens, heads, head_dim), dtype)
    k = jax.ShapeDtypeStruct((2, keys, kv_heads, head_dim), dtype)
    return q, k, k, jax.ShapeDtypeStruct((2, tokens, keys), "bool")


@pytest.mark.parametrize("keys", [512, 600])
def test_attention_over_many_keys(keys):
    rng = np.random.default_rng(0)
    q, k, v = (rng.normal(size=(2, n, h, 8)).astype("f") for n, h in ((5, 4), (keys, 2), (keys, 2)))
    mask = rng.random((2, 5, keys)) < 0.5
    actual = jax.jit(attention)(q, k, v, mask)
    k, v = (np.repeat(a, 2, axis=2) for a in (k, v))
    logits = np.einsum("btnh,bsnh->bnts", q, k)
    weights = jax.nn.softmax(np.where(mask[:, None], logits, MASKED), axis=-1)
    expected = np.einsum("bnts,bsnh->btnh", weights, v).reshape(2, 5, -1)
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-5)


@pytest.fixture
def cudnn(monkeypatch):
    """Use cuDNN, or on a host without a GPU, XLA in its place; yield the calls' arguments."""
    calls, attend = [], jax.nn.dot_product_attention
    implementation = "cudnn" if jax.default_backend() == "gpu" else "xla"

    def record(q, k, v, **options):
        assert options.pop("implementation") == "cudnn"
        calls.append({"sizes": (q.shape[1], k.shape[1]), **options})
        return attend(q, k, v, implementation=implementation, **options)

    monkeypatch.setattr(jax.nn, "dot_product_attention", record)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    return calls


@pytest.fixture
def interpreted(monkeypatch):
    """Use `short_attention` without a GPU; yield the calls' arguments."""
    calls = []

    def record(*arrays):
        calls.append(arrays)
        return short_attention(*arrays, interpret=True)

    monkeypatch.setattr(module, "platform", lambda: "gpu")
    monkeypatch.setattr(module, "short_attention", record)
    return calls


def random_inputs(tokens, keys, head_dim, dtype):
    rng = np.random.default_rng(0)
    q = rng.normal(size=(4, tokens, 4, head_dim)) / 8
    k, v = rng.normal(size=(2, 4, keys, 2, head_dim))
    return [jax.device_put(a.astype(dtype)) for a in (q, k, v)]


def result_and_gradients(q, k, v, mask):
    def run(q, k, v):
        y, vjp = jax.vjp(lambda *arrays: attention(*arrays, mask), q, k, v)
        dy = jnp.cos(jnp.arange(y.size)).reshape(y.shape)
        return y, *vjp(dy.astype(y.dtype))

    return [np.float32(a) for a in jax.jit(run)(q, k, v)]


def test_token_counts_are_padded_for_cudnn(request):
    """Padded queries and keys do not change the result."""
    arrays = random_inputs(131, 141, 64, "bfloat16")
    mask = np.random.default_rng(1).random((4, 131, 141)) < 0.5
    expected = jax.jit(functools.partial(attention))(*arrays, mask)
    calls = request.getfixturevalue("cudnn")
    actual = jax.jit(functools.partial(attention))(*arrays, mask)
    assert [call["sizes"] for call in calls] == [(136, 144)]
    np.testing.assert_allclose(actual.astype("f4"), expected.astype("f4"), atol=0.02)


@pytest.mark.parametrize(
    ("tokens", "keys", "head_dim", "dtype", "kernel"),
    [
        (5, 37, 16, "float32", None),
        (5, 600, 16, "float32", None),  # padded keys
        pytest.param(11, 37, 16, "bfloat16", "interpreted", marks=ALLOW_TRITON),
        (131, 141, 64, "bfloat16", "cudnn"),
        (136, 144, 256, "bfloat16", "cudnn"),  # nothing padded, as in pi0
    ],
)
def test_a_number_of_keys_equals_a_mask(tokens, keys, head_dim, dtype, kernel, request):
    """Values and gradients; also for a single key and for all."""
    arrays = random_inputs(tokens, keys, head_dim, dtype)
    count = np.array([1, 20, keys - 1, keys], np.int32)
    mask = np.arange(keys) < count[:, None, None]
    expected = result_and_gradients(*arrays, np.broadcast_to(mask, (4, tokens, keys)))
    calls = request.getfixturevalue(kernel) if kernel else [None]
    actual = result_and_gradients(*arrays, count)
    assert calls
    tolerance = 1e-5 if dtype == "float32" else 0.02
    for a, b in zip(actual, expected, strict=True):
        assert np.linalg.norm(a - b) <= tolerance * np.linalg.norm(b)
    for gradient in actual[2:]:  # of keys and values
        assert not gradient[~mask[:, 0]].any()


def test_cudnn_gets_numbers_of_keys_instead_of_a_mask(cudnn):
    @jax.jit
    def lengths(*arrays):
        attention(*arrays)
        return {name: a for name, a in cudnn[0].items() if name.endswith("_seq_lengths")}

    counts = np.array([3, 141, 0, 1], np.int32)
    found = lengths(*random_inputs(131, 141, 64, "bfloat16"), counts)
    (call,) = cudnn
    assert call["sizes"] == (136, 144)
    assert "mask" not in call
    np.testing.assert_array_equal(found["key_value_seq_lengths"], [3, 141, 1, 1])
    np.testing.assert_array_equal(found["query_seq_lengths"], [136] * 4)


@pytest.mark.parametrize("kernel", [None, pytest.param("interpreted", marks=ALLOW_TRITON), "cudnn"])
def test_no_keys_give_finite_results(kernel, request):
    """The mean of all values, or with cuDNN the first value."""
    tokens, keys, head_dim = (131, 141, 64) if kernel == "cudnn" else (5, 37, 16)
    arrays = random_inputs(tokens, keys, head_dim, "bfloat16")
    if kernel:
        request.getfixturevalue(kernel)
    y, *gradients = result_and_gradients(*arrays, np.zeros(4, np.int32))
    assert all(np.isfinite(gradient).all() for gradient in gradients)
    values = np.float32(arrays[2]).repeat(2, axis=2).reshape(4, keys, -1)
    expected = values[:, :1] if kernel == "cudnn" else values.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(y, np.broadcast_to(expected, y.shape), atol=0.02)


def kernel_calls(jaxpr, direction):
    """Count how often a traced program runs a kernel."""
    kernels = [e for e in equations(jaxpr) if e.primitive.name == "pallas_call"]
    return sum(f"short_attention_{direction}" in str(e.params["name"]) for e in kernels)


@ALLOW_TRITON
@pytest.mark.parametrize(
    ("platform", "keys", "head_dim", "dtype", "expected"),
    [
        ("cuda", 149, 32, "bfloat16", True),
        ("cuda", 37, 16, "float16", True),
        ("cuda", 128, 64, "bfloat16", True),
        ("cuda", 256, 32, "bfloat16", True),
        ("cuda", 129, 64, "bfloat16", False),  # might need too much shared memory
        ("cuda", 257, 16, "bfloat16", False),
        ("cuda", 37, 72, "bfloat16", False),  # pi0's vision tower
        ("cuda", 37, 256, "bfloat16", False),  # pi0's experts
        ("cuda", 37, 32, "float32", False),
        ("cpu", 37, 32, "bfloat16", False),
        ("tpu", 37, 32, "bfloat16", False),
    ],
)
def test_few_keys_use_kernels_on_gpus(platform, keys, head_dim, dtype, expected):
    with target(platform):
        jaxpr = jax.make_jaxpr(attention)(*shapes(keys, head_dim, dtype)).jaxpr
    assert kernel_calls(jaxpr, "forward") == expected


def small_policy(backbone, dtype, remat):
    """Return a loss and its parameters."""
    config = dataclasses.replace(backbone.Config.dummy(), dtype=dtype, remat=remat)
    graphdef, parameters = nnx.split(random_backbone(config))
    obs, actions = observation(config, 2), jnp.ones((2, config.chunk, config.action_dim))

    def loss(parameters):
        model = nnx.merge(graphdef, parameters)
        return model.loss(jax.random.key(0), obs, actions)[0].mean()

    return loss, parameters


@ALLOW_TRITON
@pytest.mark.parametrize("backbone", [pi0, smolvla], ids=["pi0", "smolvla"])
@pytest.mark.parametrize(
    "remat",
    [
        pytest.param("none", marks=pytest.mark.slow),
        "products",
        pytest.param("full", marks=pytest.mark.slow),
    ],
)
def test_kernels_in_a_policy(backbone, remat):
    """Of the scans over layers, only "full" has another forward kernel, in the backward pass."""
    loss, parameters = small_policy(backbone, "bfloat16", remat)
    with target("cuda"):
        jaxpr = jax.make_jaxpr(jax.grad(loss))(parameters).jaxpr
    kernels = [kernel_calls(jaxpr, direction) for direction in ("forward", "backward")]
    scans = {pi0: 3, smolvla: 4}[backbone]
    assert kernels == [2 * scans if remat == "full" else scans, scans]


@pytest.mark.slow
@pytest.mark.parametrize("backbone", [pi0, smolvla], ids=["pi0", "smolvla"])
def test_kernels_change_a_policy_by_rounding_errors_only(backbone, request):
    """XLA's own bf16 gradients differ as much from fp32: by up to 3% of a parameter's gradient."""
    loss, parameters = small_policy(backbone, "bfloat16", "products")
    expected = jax.jit(jax.value_and_grad(loss))(parameters)
    calls = request.getfixturevalue("interpreted")
    actual = jax.jit(jax.value_and_grad(loss))(parameters)
    assert calls
    np.testing.assert_allclose(actual[0], expected[0], rtol=5e-3)
    for a, b in zip(*map(jax.tree.leaves, (actual, expected)), strict=True):
        # The gradient of a key's bias is 0, except for rounding errors.
        assert np.linalg.norm(a - b) <= 0.04 * np.linalg.norm(b) + 1e-3
