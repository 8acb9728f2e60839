"""Grouped-query attention over few keys: one GPU kernel forward, one backward.

XLA writes fp32 logits and weights `[B, T, N, S]` to memory and reads them several times per pass.
Here, a program holds the logits of a block of queries and all their keys in registers, so nothing
of that size is stored: the backward pass recomputes the weights from q, k and the logarithm of each
row's softmax denominator (FlashAttention-2, Dao, arXiv 2307.08691).

All sums run in a fixed order: two runs give the same bits, unlike cuDNN's backward pass. In that
pass, one program handles all queries of a key head and sums the gradients of its keys and values.

Forward and backward pass on an H200, bf16, batch size 128: small pi0's language model (138 tokens,
8 heads of 32, one key head) takes 265 us, 398 in XLA and 355 in cuDNN; small SmolVLA's (43 tokens)
50, 97 and 119; the vision tower of both (256 images, 64 patches, 4 heads of 64) 45, 92 and 133.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl

from lorasp_jax.kernels.blocks import LOG2_E, MASKED, Launch, load, matmul, store
from lorasp_jax.kernels.rematerialization import save_for_backward
from lorasp_jax.kernels.row_sharding import by_rows

MAX_KEYS = 256
"""Maximum number of keys: their logits must fit in registers."""
HEAD_DIMS = (16, 32, 64, 128)
"""Supported head sizes."""
MAX_KEY_ELEMENTS = 8192
"""Maximum number of keys times head size in general use. Up to here, the backward pass needs at
most 88 KiB of shared memory on GPUs with 99 KiB, compiled with Triton 3.9; twice as many need 120.
"""


FORWARD = Launch(rows=64, keys=128, warps=4)
BACKWARD = Launch(rows=64, keys=64, warps=4)
"""Launch parameters of the two passes."""


class _Static(NamedTuple):
    launches: tuple[Launch, Launch]
    interpret: bool


def short_attention(
    q: jax.Array,
    k: jax.Array,
    v: jax.Array,
    mask: jax.Array | None,
    *,
    launches: tuple[Launch, Launch] = (FORWARD, BACKWARD),
    interpret: bool = False,
) -> jax.Array:
    """Apply grouped-query attention with an fp32 softmax; reproducible bit for bit.

    Batch entries may be sharded over devices. There is no forward-mode derivative.

    Args:
        q: `[B, T, N, H]`, already scaled, 16-bit float on a GPU; H must be in `HEAD_DIMS`.
        k: `[B, S, K, H]`; each key head serves N / K query heads; S is at most `MAX_KEYS`.
        v: `[B, S, K, H]`.
        mask: `[B, T, S]` bool, or None to attend to all keys. A query without keys attends to all
            of them equally.
        launches: launch parameters of the forward and the backward kernel.
        interpret: run without a GPU, slowly.

    Returns:
        `[B, T, N H]`.
    """
    return _attention(_Static(launches, interpret), q, k, v, mask)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _attention(
    static: _Static, q: jax.Array, k: jax.Array, v: jax.Array, mask: jax.Array | None
) -> jax.Array:
    return _forward(static, q, k, v, mask)[0]


def _forward(
    static: _Static, q: jax.Array, k: jax.Array, v: jax.Array, mask: jax.Array | None
) -> tuple[jax.Array, tuple]:
    grouped, launch = _group_heads(q, k), static.launches[0]
    batch, tokens, kv_heads, group, _ = grouped.shape
    arrays = [grouped, k, v, *_as_bytes(mask)]
    y, log_sums = _call(
        _forward_kernel,
        static,
        launch,
        grid=(pl.cdiv(tokens * group, launch.rows), kv_heads),
        arrays=arrays,
        like=[(grouped.shape, v.dtype), ((batch, tokens, kv_heads, group), jnp.float32)],
    )
    y = y.reshape(*q.shape[:2], -1)
    return y, (q, k, v, mask, y, log_sums)


def _backward(static: _Static, residuals: tuple, dy: jax.Array) -> tuple:
    q, k, v, mask, y, log_sums = residuals
    grouped = _group_heads(q, k)
    y, dy = (a.reshape(grouped.shape) for a in (y, dy))
    dq, dk, dv = _call(
        _backward_kernel,
        static,
        static.launches[1],
        grid=(1, k.shape[2]),
        arrays=[grouped, k, v, *_as_bytes(mask), y, dy, log_sums],
        like=[(a.shape, a.dtype) for a in (grouped, k, v)],
    )
    return dq.reshape(q.shape), dk, dv, None


_attention.defvjp(_forward, _backward)


def _group_heads(q: jax.Array, k: jax.Array) -> jax.Array:
    """Reshape q to `[B, T, K, G, H]`, the G query heads of each key head together."""
    batch, tokens, _, size = q.shape
    return q.reshape(batch, tokens, k.shape[2], -1, size)


def _as_bytes(mask: jax.Array | None) -> list[jax.Array]:
    return [] if mask is None else [mask.astype(jnp.int8)]


def _call(
    kernel: Any,
    static: _Static,
    launch: Launch,
    *,
    grid: tuple[int, int],
    arrays: list[jax.Array],
    like: list[tuple[tuple[int, ...], Any]],
) -> Any:
    """Launch the kernel with `grid` programs per batch entry, each device on its own entries."""
    from jax.experimental.pallas import triton  # absent from builds without NVIDIA support

    def run(_: Any, arrays: Any) -> tuple[Any, list[jax.Array]]:
        batch = len(arrays[0])
        outputs = pl.pallas_call(
            functools.partial(kernel, launch),
            grid=(*grid, batch),
            out_shape=[jax.ShapeDtypeStruct((batch, *shape[1:]), dtype) for shape, dtype in like],
            compiler_params=triton.CompilerParams(num_warps=launch.warps, num_stages=1),
            interpret=static.interpret,
            name=f"short_attention{kernel.__name__.removesuffix('_kernel')}",
        )(*arrays)
        return outputs, []

    return jax.tree.map(save_for_backward, by_rows(run, [], arrays)[0])


class _Block(NamedTuple):
    """Some rows, or some keys, of one batch entry and one key head."""

    at: tuple
    """Index of the n rows in `[B, T, K, G, ...]`, or of the n keys in `[B, S, K, ...]`."""
    exist: jax.Array | None
    """bool [n], False for padding; None without padding."""

    def load(self, ref: Any) -> jax.Array:
        """Load [n] or [n, H]; padding is 0."""
        at, exist = self._of(ref)
        return load(ref, at, exist)

    def store(self, ref: Any, values: jax.Array) -> None:
        """Store all but the padding, in the dtype of the array."""
        at, exist = self._of(ref)
        store(ref, at, values, exist)

    def _of(self, ref: Any) -> tuple[tuple, jax.Array | None]:
        """Return index and existence of all elements in this array."""
        if len(self.at) == len(ref.shape):
            return self.at, self.exist
        at = tuple(i[:, None] if jnp.ndim(i) else i for i in self.at)
        at = (*at, jnp.arange(ref.shape[-1])[None])
        return at, None if self.exist is None else self.exist[:, None]


class _Program(NamedTuple):
    """Launch parameters, batch entry and key head of a program."""

    launch: Launch
    batch: jax.Array
    head: jax.Array

    def rows(self, block: Any, shape: tuple[int, ...]) -> _Block:
        """Return a block of rows of q, whose shape is `[B, T, K, G, H]`."""
        _, tokens, _, group, _ = shape
        row = block * self.launch.rows + jnp.arange(self.launch.rows)
        token, member = jax.lax.div(row, group), jax.lax.rem(row, group)
        return _Block((self.batch, token, self.head, member), row < tokens * group)

    def keys(self, count: int) -> list[_Block]:
        """Cover `count` keys, padded to a multiple of 16, by as few powers of two as possible."""
        blocks, start = [], 0
        while start < count:
            left = count - start
            width = max(16, min(self.launch.keys, 1 << (left.bit_length() - 1)))
            key = start + jnp.arange(width)
            exist = key < count if width > left else None
            blocks.append(_Block((self.batch, key, self.head), exist))
            start += width
        return blocks


def _forward_kernel(launch: Launch, q_ref: Any, k_ref: Any, v_ref: Any, *others: Any) -> None:
    """Write one block of rows of the result, and the log2 of their softmax denominators."""
    *mask_ref, y_ref, log_sum_ref = others
    program = _Program(launch, pl.program_id(2), pl.program_id(1))
    rows, chunks = program.rows(pl.program_id(0), q_ref.shape), program.keys(k_ref.shape[1])
    q = rows.load(q_ref)
    logits = []
    for keys in chunks:
        # In base 2, since the GPU has an instruction for 2^x and not for e^x.
        x = matmul(q, keys.load(k_ref), (1, 1)) * LOG2_E
        for ref in mask_ref:
            x = jnp.where(_load_mask(ref, rows, keys), x, MASKED)
        # -inf for keys that do not exist: even a fully masked row gives them no weight.
        logits.append(x if keys.exist is None else jnp.where(keys.exist[None], x, -jnp.inf))
    # All keys are at hand, so one maximum per row suffices; there is no online softmax.
    top = functools.reduce(jnp.maximum, [x.max(1) for x in logits])
    total, y = jnp.zeros_like(top), jnp.zeros(q.shape, jnp.float32)
    for keys, x in zip(chunks, logits, strict=True):
        weights = jnp.exp2(x - top[:, None])
        total += weights.sum(1)
        y += matmul(weights.astype(v_ref.dtype), keys.load(v_ref), (1, 0))
    # Dividing y instead of the weights costs H operations per row instead of S.
    rows.store(y_ref, y / total[:, None])
    rows.store(log_sum_ref, top + jnp.log2(total))


def _backward_kernel(launch: Launch, q_ref: Any, k_ref: Any, v_ref: Any, *others: Any) -> None:
    """Write the gradients of one key head: dq block by block, then the sums dk and dv."""
    *mask_ref, y_ref, dy_ref, log_sum_ref, dq_ref, dk_ref, dv_ref = others
    num_keys, size = k_ref.shape[1], k_ref.shape[3]
    program = _Program(launch, pl.program_id(2), pl.program_id(1))
    chunks = program.keys(num_keys)
    # Loaded once, before the loop over the blocks of queries.
    loaded = [(keys.load(k_ref), keys.load(v_ref)) for keys in chunks]

    def block(i: Any, sums: list[tuple]) -> list[tuple]:
        rows = program.rows(i, q_ref.shape)
        q, dy, log_sum = (rows.load(ref) for ref in (q_ref, dy_ref, log_sum_ref))
        # Masked logits are constants, so a fully masked row gets no gradient of q. Its log_sum is
        # rounded to MASKED, which would make its weights 1 instead of 1 / S.
        some = log_sum > MASKED / 2
        masked = jnp.where(some, -jnp.inf, -math.log2(num_keys))[:, None]
        if mask_ref:
            q = jnp.where(some[:, None], q, jnp.zeros_like(q))
        # Σ_j w_j dw_j of the softmax's gradient equals dy · y, without another pass over keys.
        mean = (dy.astype(jnp.float32) * rows.load(y_ref).astype(jnp.float32)).sum(1)
        dq, results = jnp.zeros(q.shape, jnp.float32), []
        for keys, (k, v), (dk, dv) in zip(chunks, loaded, sums, strict=True):
            log_weights = matmul(q, k, (1, 1)) * LOG2_E - log_sum[:, None]
            for ref in mask_ref:
                log_weights = jnp.where(_load_mask(ref, rows, keys), log_weights, masked)
            if keys.exist is not None:
                log_weights = jnp.where(keys.exist[None], log_weights, -jnp.inf)
            weights = jnp.exp2(log_weights)  # normalized: log_sum holds the denominator
            dx = (weights * (matmul(dy, v, (1, 1)) - mean[:, None])).astype(q.dtype)
            dq += matmul(dx, k, (1, 0))
            dv += matmul(weights.astype(dy.dtype), dy, (0, 0))
            results.append((dk + matmul(dx, q, (0, 0)), dv))
        rows.store(dq_ref, jnp.where(some[:, None], dq, 0) if mask_ref else dq)
        return results

    # One program per key head adds up dk and dv in a fixed order.
    zeros = [(jnp.zeros((len(keys.at[1]), size), jnp.float32),) * 2 for keys in chunks]
    num_blocks = pl.cdiv(q_ref.shape[1] * q_ref.shape[3], launch.rows)
    for keys, (dk, dv) in zip(chunks, jax.lax.fori_loop(0, num_blocks, block, zeros), strict=True):
        keys.store(dk_ref, dk)
        keys.store(dv_ref, dv)


def _load_mask(ref: Any, rows: _Block, keys: _Block) -> jax.Array:
    """Load bool [rows, keys] from `[B, T, S]`; padding is False."""
    (batch, token, *_), (_, key, _) = rows.at, keys.at
    exist = jnp.asarray(rows.exist)[:, None]
    if keys.exist is not None:
        exist &= keys.exist[None]
    return load(ref, (batch, token[:, None], key[None]), exist) != 0
