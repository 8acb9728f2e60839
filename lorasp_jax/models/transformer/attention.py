"""Grouped-query attention with masks and fp32 softmax."""

import functools

import jax
import jax.numpy as jnp

from lorasp_jax.kernels.cached_attention import HEAD_DIMS as CACHED_HEAD_DIMS
from lorasp_jax.kernels.cached_attention import MAX_NARROW, KeysValues, cached_attention
from lorasp_jax.kernels.platform import has_large_shared_memory, platform
from lorasp_jax.kernels.short_attention import (
    HEAD_DIMS,
    MAX_KEY_ELEMENTS,
    MAX_KEYS,
    short_attention,
)

MASKED = -2.3819763e38
"""Logit of a masked key. Finite, so that a fully masked row gets a uniform softmax, not NaN."""

CUDNN_MIN_QUERIES, CUDNN_MIN_HEAD_DIM = 128, 64
"""Minimum sizes for cuDNN. Miniatures do not reach both, so their results are bitwise
reproducible."""

KEY_MULTIPLE, MIN_PADDED_KEYS = 128, 512
"""Without cuDNN, masked attention pads `MIN_PADDED_KEYS` or more keys to a multiple of
`KEY_MULTIPLE`."""

MAX_QUERY_ELEMENTS = 400_000
"""Maximum size of q for `kernels.cached_attention`: three observations for pi0, eight for SmolVLA.
One takes 11 instead of 12 us for pi0, 6 instead of 11 us for SmolVLA; eight take 57 instead of 27,
and 14 instead of 17 us (H200, with what XLA has to do before and after)."""

CUDNN_MULTIPLE = 8
"""With a mask, cuDNN needs query and key counts divisible by 8 (16-byte alignment of the mask)."""


def attention(
    q: jax.Array,
    k: jax.Array,
    v: jax.Array,
    mask: jax.Array | None,
    cache: KeysValues | None = None,
) -> jax.Array:
    """Grouped-query attention with fp32 softmax; 16-bit floats on GPUs use faster kernels.

    These are cuDNN for many queries, `kernels.short_attention` for few keys, and, without gradient,
    `kernels.cached_attention` for few queries. cuDNN is faster with numbers of keys than with a
    mask: forward and backward pass of a layer of pi0's language model take 2.8 instead of 5.0 ms
    (H200, bf16, batch size 32, 816 tokens, 8 heads of 256, one key head).

    cuDNN accumulates gradients in nondeterministic order: two runs differ by rounding errors.
    None of them has a forward-mode derivative, and the first two have no second derivative.

    Args:
        q: `[B, T, N, H]`, already scaled.
        k: `[B, S, K, H]`; each key head serves N / K query heads.
        v: `[B, S, K, H]`.
        mask: `[B, T, S]` bool; or `[B]` int32, if all queries attend to the first mask[b] keys; or
            None to attend to all keys. A query without keys attends to all of them equally, but
            with cuDNN and `[B]` to the first one.
        cache: keys and values that precede k and v, or None. S of the mask counts both.

    Returns:
        `[B, T, N H]`.
    """
    if mask is not None and _use_cached_attention(q, mask):
        return _few_queries(q, (k, v), cache, mask)
    return _concatenated(q, (k, v), cache, mask)


@jax.custom_vjp
def _few_queries(
    q: jax.Array, own: KeysValues, cache: KeysValues | None, mask: jax.Array
) -> jax.Array:
    before, last = (own, None) if cache is None else (cache, own)
    return cached_attention(q, last, before, mask)


_few_queries.defvjp(lambda *arrays: jax.vjp(_concatenated, *arrays), lambda vjp, dy: vjp(dy))


def _concatenated(
    q: jax.Array, own: KeysValues, cache: KeysValues | None, mask: jax.Array | None
) -> jax.Array:
    """`attention` with the cached keys and values in front of the queries' own."""
    k, v = own
    if cache is not None:
        k, v = (jnp.concatenate(pair, axis=1) for pair in zip(cache, own, strict=True))
    batch, tokens, heads, size = q.shape
    if _use_cudnn(q, k, mask):
        return _cudnn_attention(q, k, v, mask)[:, :tokens].reshape(batch, tokens, heads * size)
    if mask is not None and mask.ndim == 1:
        first = jnp.arange(k.shape[1]) < mask[:, None]
        mask = jnp.broadcast_to(first[:, None], (batch, tokens, k.shape[1]))
    if _use_short_attention(q, k.shape[1]):
        return short_attention(q, k, v, mask)
    k, v, mask = _pad_keys(k, v, mask)
    # For K = 1, this axis order needs no transposes of q, the weights or the result.
    q = q.reshape(batch, tokens, k.shape[2], -1, size)
    logits = jnp.einsum("BTKGH,BSKH->BKTGS", q, k, preferred_element_type=jnp.float32)
    if mask is not None:
        logits = jnp.where(mask[:, None, :, None, :], logits, MASKED)
    weights = jax.nn.softmax(logits, axis=-1).astype(v.dtype)
    return jnp.einsum("BKTGS,BSKH->BTKGH", weights, v).reshape(batch, tokens, heads * size)


def _pad_keys(
    k: jax.Array, v: jax.Array, mask: jax.Array | None
) -> tuple[jax.Array, jax.Array, jax.Array | None]:
    """Append masked keys. XLA would instead pad the attention weights, which costs another copy."""
    padding = -k.shape[1] % KEY_MULTIPLE
    if mask is None or padding == 0 or k.shape[1] < MIN_PADDED_KEYS:
        return k, v, mask
    mask = jnp.pad(mask, ((0, 0), (0, 0), (0, padding)))
    return _pad_tokens(k, padding), _pad_tokens(v, padding), mask


def _use_cudnn(q: jax.Array, k: jax.Array, mask: jax.Array | None) -> bool:
    """Whether cuDNN supports these arrays and is worth its launch overhead."""
    queries, head_dim, keys = q.shape[1], q.shape[3], k.shape[1]
    half_precision = q.dtype in (jnp.bfloat16, jnp.float16)
    even = mask is not None or (queries % 2 == 0 and keys % 2 == 0)  # masked inputs get padded
    supported = CUDNN_MIN_HEAD_DIM <= head_dim <= 256 and head_dim % 8 == 0 and even
    large = queries >= CUDNN_MIN_QUERIES
    on_gpu = platform() == jax.default_backend() == "gpu"  # cannot be lowered elsewhere
    return on_gpu and half_precision and supported and large


def _use_cached_attention(q: jax.Array, mask: jax.Array) -> bool:
    """Whether the kernel supports these arrays, and no kernel with a gradient does."""
    dim, half_precision = q.shape[3], q.dtype in (jnp.bfloat16, jnp.float16)
    few = q.shape[1] < CUDNN_MIN_QUERIES and q.size <= MAX_QUERY_ELEMENTS and mask.ndim == 3
    fits = dim in CACHED_HEAD_DIMS and (dim <= MAX_NARROW or has_large_shared_memory())
    chosen = platform() == "gpu" and half_precision and few and fits
    return chosen and not _use_short_attention(q, mask.shape[-1])


def _use_short_attention(q: jax.Array, keys: int) -> bool:
    """Whether the kernel supports q and this number of keys, on all GPUs since Ampere."""
    head_dim = q.shape[3]
    half_precision = q.dtype in (jnp.bfloat16, jnp.float16)
    few = keys <= MAX_KEYS and keys * head_dim <= MAX_KEY_ELEMENTS
    return platform() == "gpu" and half_precision and head_dim in HEAD_DIMS and few


def _cudnn_attention(q: jax.Array, k: jax.Array, v: jax.Array, mask: jax.Array | None) -> jax.Array:
    """Return `[B, T, N, H]`; with a mask, T is rounded up to a multiple of `CUDNN_MULTIPLE`."""
    attend = functools.partial(jax.nn.dot_product_attention, implementation="cudnn", scale=1.0)
    if mask is None:
        return attend(q, k, v)
    queries, keys = (-a.shape[1] % CUDNN_MULTIPLE for a in (q, k))
    q, k, v = (_pad_tokens(a, n) for a, n in ((q, queries), (k, keys), (v, keys)))
    if mask.ndim == 1:
        # Computed from the mask, the queries' constant number is sharded and vmapped like it.
        all_queries = jnp.clip(mask, q.shape[1], q.shape[1])
        some_keys = jnp.maximum(mask, 1)
        return attend(q, k, v, query_seq_lengths=all_queries, key_value_seq_lengths=some_keys)
    return attend(q, k, v, mask=jnp.pad(mask, ((0, 0), (0, queries), (0, keys)))[:, None])


def _pad_tokens(x: jax.Array, padding: int) -> jax.Array:
    """Append zeros to the token axis of x `[B, T, N, H]`."""
    return jnp.pad(x, ((0, 0), (0, padding), (0, 0), (0, 0))) if padding else x
