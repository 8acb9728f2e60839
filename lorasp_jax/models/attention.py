"""Attention: grouped queries, masks, softmax in fp32."""

import functools

import jax
import jax.numpy as jnp

MASKED = -2.3819763e38
"""Logit of a forbidden key; finite, so a row without any key gets a uniform softmax, not NaN."""

CUDNN_TOKENS, CUDNN_WIDTH = 256, 64
"""Fewest queries and narrowest heads for which attention goes through cuDNN: those of published
sizes, while the miniatures repeat themselves bit for bit."""

ALIGNED, LONG = 128, 512
"""What the number of keys is made a multiple of, and from how many on."""


def attention(q: jax.Array, k: jax.Array, v: jax.Array, mask: jax.Array | None) -> jax.Array:
    """Grouped-query attention, softmax in fp32; long bf16 sequences through cuDNN on NVIDIA GPUs.

    cuDNN's gradient adds up in any order: two runs differ in the last bits. Hence `CUDNN_WIDTH`.

    Args:
        q: `[B, T, N, H]`, already scaled.
        k: `[B, S, K, H]`; each key head serves N / K query heads.
        v: `[B, S, K, H]`.
        mask: `[B, T, S]` bool, or None for all pairs.

    Returns:
        `[B, T, N H]`.
    """
    batch, tokens, heads, size = q.shape
    if _suits_cudnn(q, k):
        allowed = None if mask is None else mask[:, None]
        attend = functools.partial(jax.nn.dot_product_attention, implementation="cudnn")
        return attend(q, k, v, mask=allowed, scale=1.0).reshape(batch, tokens, heads * size)
    k, v, mask = _aligned(k, v, mask)
    # With K = 1 no axis of q, weights or result moves in memory.
    q = q.reshape(batch, tokens, k.shape[2], -1, size)
    logits = jnp.einsum("BTKGH,BSKH->BKTGS", q, k, preferred_element_type=jnp.float32)
    if mask is not None:
        logits = jnp.where(mask[:, None, :, None, :], logits, MASKED)
    weights = jax.nn.softmax(logits, axis=-1).astype(v.dtype)
    return jnp.einsum("BKTGS,BSKH->BTKGH", weights, v).reshape(batch, tokens, heads * size)


def _aligned(
    k: jax.Array, v: jax.Array, mask: jax.Array | None
) -> tuple[jax.Array, jax.Array, jax.Array | None]:
    """Forbidden keys behind the others: XLA would write the weights once more to pad them."""
    more = -k.shape[1] % ALIGNED
    if mask is None or more == 0 or k.shape[1] < LONG:
        return k, v, mask
    k, v = (jnp.pad(a, ((0, 0), (0, more), (0, 0), (0, 0))) for a in (k, v))
    return k, v, jnp.pad(mask, ((0, 0), (0, 0), (0, more)))


def _suits_cudnn(q: jax.Array, k: jax.Array) -> bool:
    """Whether cuDNN takes these arrays and is worth its launch."""
    tokens, size, others = q.shape[1], q.shape[3], k.shape[1]
    half = q.dtype in (jnp.bfloat16, jnp.float16)
    fits = CUDNN_WIDTH <= size <= 256 and size % 8 == 0 and tokens % 2 == 0 and others % 2 == 0
    return jax.default_backend() == "gpu" and half and fits and tokens >= CUDNN_TOKENS
