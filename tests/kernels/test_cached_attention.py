import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.kernels.blocks import Launch
from lorasp_jax.kernels.cached_attention import cached_attention
from lorasp_jax.models.transformer import attention
from lorasp_jax.training.cost import flops
from tests.cases import mostly_slow
from tests.jaxprs import target

BATCH, TOKENS, KV_HEADS, GROUP, DIM = 2, 5, 2, 3, 16
LAUNCHES = {
    "one_program": Launch(rows=16, keys=16, programs=1, warps=1),
    "splits": Launch(rows=16, keys=16, programs=2, warps=1),
    "more_splits_than_blocks": Launch(rows=16, keys=16, programs=9, warps=1),
    "one_block": Launch(rows=32, keys=64, programs=1, warps=1),
    "default": None,
}


def inputs(cached, own, dtype=jnp.float32):
    """q, own keys and values, cached ones, and a mask that hides some keys from some queries."""
    rng = np.random.default_rng(0)
    draw = lambda *shape: rng.normal(size=(BATCH, *shape)).astype(dtype)  # noqa: E731
    q = draw(TOKENS, KV_HEADS * GROUP, DIM)
    own_pair, cache = (
        tuple(draw(count, KV_HEADS, DIM) for _ in range(2)) if count else None
        for count in (own, cached)
    )
    mask = rng.random((BATCH, TOKENS, cached + own)) < 0.7
    mask[:, :, -1] = True
    return q, own_pair, cache, mask


@jax.jit
def concatenated(q, own, cache, mask):
    """Attention over cached and own keys in one array, in f32."""
    arrays = jax.tree.map(lambda a: a.astype(jnp.float32), (q, own or cache, own and cache))
    return attention._concatenated(*arrays, mask)


SIZES = {"partial": (20, TOKENS), "full": (32, TOKENS), "cached": (37, 0), "full_cached": (32, 0)}
CASES = [f"{size}-{launch}" for size in SIZES for launch in LAUNCHES]
QUICK = [c for c in CASES if c.startswith("partial-") or c.endswith("-splits")]


@pytest.mark.parametrize("case", mostly_slow(CASES, QUICK))
def test_matches_attention_over_concatenated_keys(case):
    size, launch = case.split("-")
    arrays = inputs(*SIZES[size])
    actual = cached_attention(*arrays, launch=LAUNCHES[launch], interpret=True)
    np.testing.assert_allclose(actual, concatenated(*arrays), atol=1e-5)


def test_matches_in_half_precision():
    arrays = inputs(20, 5, jnp.float16)
    actual = cached_attention(*arrays, launch=LAUNCHES["splits"], interpret=True)
    assert actual.dtype == jnp.float16
    np.testing.assert_allclose(actual, concatenated(*arrays), atol=2e-3)


def test_a_query_without_keys_attends_to_all_of_them_equally():
    q, own, cache, mask = inputs(20, 5)
    mask[0, 1] = False
    y = cached_attention(q, own, cache, mask, launch=LAUNCHES["splits"], interpret=True)
    values = np.concatenate([cache[1], own[1]], axis=1)[0].mean(0)
    expected = np.repeat(values, GROUP, axis=0).reshape(-1)
    np.testing.assert_allclose(np.asarray(y)[0, 1], expected, atol=1e-6)


def test_large_logits_do_not_overflow():
    q, *others = inputs(20, 5)
    q *= 10_000
    y = cached_attention(q, *others, launch=LAUNCHES["splits"], interpret=True)
    np.testing.assert_allclose(y, concatenated(q, *others), atol=1e-5)


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
    np.testing.assert_allclose(*(jax.jit(f)(q) for f in (run, plain)), atol=0.02)
    assert len(interpreted) == 1
    gradient = lambda f: jax.jit(jax.grad(lambda q: jnp.sin(f(q)).sum()))(q)  # noqa: E731
    actual, expected = map(gradient, (run, plain))
    np.testing.assert_array_equal(actual, expected)
    assert len(interpreted) == 1


@pytest.mark.parametrize("shared", [(), ("cache",), ("cache", "mask")], ids=str)
def test_a_batch_can_be_mapped(interpreted, shared):
    q, (k, v), cache, mask = inputs(20, 5, jnp.bfloat16)
    if "cache" in shared:
        cache = jax.tree.map(lambda a: a[:1].repeat(BATCH, 0), cache)
    if "mask" in shared:
        mask = mask[:1].repeat(BATCH, 0)
    attend = lambda *arrays: attention.attention(*arrays)  # noqa: E731, PLW0108  # traced anew
    expected = jax.jit(attend)(q, k, v, mask, cache)
    lift = lambda name, a: a[:1] if name in shared else a[:, None]  # noqa: E731
    arrays = (q[:, None], k[:, None], v[:, None], lift("mask", mask))
    lifted = jax.tree.map(lambda a: lift("cache", a), cache)
    axes = (0, 0, 0, None if "mask" in shared else 0, None if "cache" in shared else 0)
    actual = jax.jit(jax.vmap(attend, in_axes=axes))(*arrays, lifted)
    np.testing.assert_array_equal(np.asarray(actual)[:, 0], expected)


def test_a_mask_may_be_shared_by_batch_and_queries():
    q, own, cache, mask = inputs(20, 5)
    call = functools.partial(cached_attention, launch=LAUNCHES["splits"], interpret=True)
    one = mask[:1, :1]
    expected = call(q, own, cache, np.broadcast_to(one, mask.shape))
    np.testing.assert_array_equal(call(q, own, cache, one), expected)


on_gpu = functools.partial(target, "cuda", "NVIDIA H200")


def published(name):
    """Shapes of q, own and cached keys and values, and the mask, at published sizes."""
    tokens, heads, kv_heads, dim, cached = {
        "pi0": (51, 8, 1, 256, 816),
        "pi05": (50, 8, 1, 256, 968),
        "smolvla": (50, 15, 5, 64, 177),
    }[name]
    shape = lambda *s: jax.ShapeDtypeStruct(s, "bfloat16")  # noqa: E731
    q, own, cache = (
        shape(1, t, n, dim) for t, n in ((tokens, heads), (tokens, kv_heads), (cached, kv_heads))
    )
    mask = jax.ShapeDtypeStruct((1, tokens, cached + tokens), bool)
    return q, own, own, mask, (cache, cache)


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
@pytest.mark.parametrize("x64", [False, True])
@pytest.mark.parametrize("name", ["pi0", "pi05", "smolvla"])
def test_lowers_for_a_gpu_to_one_kernel(name, x64):
    arrays = published(name)
    with on_gpu(), jax.enable_x64(x64):
        traced = jax.jit(attention.attention).trace(*arrays)
        text = traced.lower(lowering_platforms=("cuda",)).as_text()
        assert text.count("custom_call @__gpu$xla.gpu.triton") == 1


def test_many_queries_and_small_gpus_do_not_use_the_kernel(monkeypatch):
    q, _, _, mask, _ = published("pi0")
    many = jax.ShapeDtypeStruct((8, *q.shape[1:]), q.dtype)
    narrow = published("smolvla")
    with on_gpu():
        assert attention._use_cached_attention(q, mask)
        assert not attention._use_cached_attention(many, mask)
        monkeypatch.setattr(attention, "has_large_shared_memory", lambda: False)
        assert not attention._use_cached_attention(q, mask)
        assert attention._use_cached_attention(narrow[0], narrow[3])


def test_flops_are_those_of_xla():
    arrays = published("smolvla")
    expected = flops.count(attention.attention, *arrays)
    with on_gpu():
        assert "cached_attention" in str(jax.make_jaxpr(attention.attention)(*arrays))
        assert flops.count(attention.attention, *arrays) == expected > 0
