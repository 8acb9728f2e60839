"""Attention: grouped queries, masks, softmax in fp32."""

import functools

import jax
import jax.numpy as jnp

MASKED = -2.3819763e38
"""Logit of a forbidden key; finite, so a row without any key gets a uniform softmax, not NaN."""

CUDNN_TOKENS, CUDNN_WIDTH = 128, 64
"""Fewest queries and narrowest heads for which attention goes through cuDNN: those of published
sizes, while the miniatures repeat themselves bit for bit."""

ALIGNED, LONG = 128, 512
"""What the number of keys is made a multiple of, and from how many on."""

CUDNN_ALIGNED = 8
"""What cuDNN gets a multiple of, queries and keys: 16 bytes of a mask."""


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
    if _suits_cudnn(q, k, mask):
        attend = functools.partial(jax.nn.dot_product_attention, implementation="cudnn", scale=1.0)
        if mask is not None:
            q, k, v, mask = _filled_up(q, k, v, mask)
        y = attend(q, k, v, mask=None if mask is None else mask[:, None])
        return y[:, :tokens].reshape(batch, tokens, heads * size)
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
    return _longer(k, more), _longer(v, more), jnp.pad(mask, ((0, 0), (0, 0), (0, more)))


def _suits_cudnn(q: jax.Array, k: jax.Array, mask: jax.Array | None) -> bool:
    """Whether cuDNN takes these arrays and is worth its launch."""
    tokens, size, others = q.shape[1], q.shape[3], k.shape[1]
    half = q.dtype in (jnp.bfloat16, jnp.float16)
    even = mask is not None or (tokens % 2 == 0 and others % 2 == 0)
    fits = CUDNN_WIDTH <= size <= 256 and size % 8 == 0 and even
    return jax.default_backend() == "gpu" and half and fits and tokens >= CUDNN_TOKENS


def _filled_up(
    q: jax.Array, k: jax.Array, v: jax.Array, mask: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """The same with numbers of queries and keys that cuDNN takes.

    The further keys are forbidden, and so are all of a further query, whose result is not read.
    """
    queries, keys = (-a.shape[1] % CUDNN_ALIGNED for a in (q, k))
    q, k, v = (_longer(a, more) for a, more in ((q, queries), (k, keys), (v, keys)))
    return q, k, v, jnp.pad(mask, ((0, 0), (0, queries), (0, keys)))


def _longer(x: jax.Array, more: int) -> jax.Array:
    """x `[B, T, N, H]` with zeros behind the T tokens."""
    return jnp.pad(x, ((0, 0), (0, more), (0, 0), (0, 0))) if more else x
