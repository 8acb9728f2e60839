"""Grouped-query attention of few queries to cached keys and to their own.

In a flow step, about fifty action tokens attend to the keys of the observation, computed once, and
to their own. XLA concatenates and pads both, and stores logits and weights, which takes eight
kernels of about two microseconds per layer. Here, one kernel reads the keys where they are. Its
programs share out queries and keys (Flash-Decoding, Dao et al., 2023), and XLA combines their
results in a second kernel.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl

from lorasp_jax.kernels.blocks import LOG2_E, MASKED, Launch, load, matmul, store
from lorasp_jax.kernels.row_sharding import by_rows

KeysValues = tuple[jax.Array, jax.Array]
"""Keys and values, `[B, S, K, H]` each, or `[L, B, S, K, H]` for all layers."""

HEAD_DIMS = (16, 32, 64, 128, 256)
"""Supported head sizes."""


NARROW = Launch(rows=32, keys=64, programs=4, warps=4)
WIDE, MAX_NARROW = Launch(rows=32, keys=128, programs=8, warps=8), 128
"""Launch parameters for heads of up to MAX_NARROW dimensions, and for wider ones: the fastest of
about ten each on an H200, for SmolVLA and pi0. They take 43 and 148 KiB of shared memory."""


class _Size(NamedTuple):
    """Numbers of heads and keys, and how programs share the keys."""

    heads: int
    """N."""
    kv_heads: int
    """K."""
    cached: int
    own: int
    """0 or T."""
    cached_blocks: int
    """Number of blocks of cached keys, the last one padded. Those of own keys follow."""
    blocks: int
    per_program: int
    """Number of blocks per program."""

    @property
    def splits(self) -> int:
        """Number of programs that share the blocks."""
        return pl.cdiv(self.blocks, self.per_program)


def cached_attention(
    q: jax.Array,
    own: KeysValues | None,
    cache: KeysValues,
    mask: jax.Array,
    *,
    launch: Launch | None = None,
    interpret: bool = False,
) -> jax.Array:
    """Apply grouped-query attention with an fp32 softmax; without gradient.

    Batch entries may be sharded over devices.

    Args:
        q: `[B, T, N, H]`, already scaled, 16-bit float on a GPU; H must be in `HEAD_DIMS`.
        own: keys and values of the T queries' tokens, or None.
        cache: keys and values that precede `own`; each of the K key heads serves N / K query heads.
        mask: `[B or 1, T or 1, S]` bool, where S counts both. A query without keys attends to all
            equally.
        launch: launch parameters; None: by head size.
        interpret: run without a GPU, slowly.

    Returns:
        `[B, T, N H]`.
    """
    batch, tokens, heads, dim = q.shape
    launch = launch or (NARROW if dim <= MAX_NARROW else WIDE)
    cached, kv_heads = cache[0].shape[1:3]
    num_own = 0 if own is None else tokens
    cached_blocks, own_blocks = (pl.cdiv(count, launch.keys) for count in (cached, num_own))
    blocks = cached_blocks + own_blocks
    per_program = pl.cdiv(blocks, launch.programs)
    size = _Size(heads, kv_heads, cached, num_own, cached_blocks, blocks, per_program)
    # XLA computes all that belongs to these tokens, with RoPE, in one kernel.
    tokens_array = q if own is None else jnp.concatenate([q, *own], axis=2)
    mask = jnp.broadcast_to(mask, (batch, tokens, mask.shape[-1])).astype(jnp.int8)
    call = functools.partial(_call, launch, size, interpret)
    y, top, total = by_rows(call, [], [tokens_array, mask, *cache])[0]
    return _combine(y, top, total).astype(q.dtype).reshape(batch, tokens, heads * dim)


def _combine(y: jax.Array, top: jax.Array, total: jax.Array) -> jax.Array:
    """Combine the weighted sums `[B, P, ...]` of P programs, given the maximum of their logits.

    A Python loop, so that XLA computes everything in one kernel.
    """
    tops, totals, ys = ([a[:, i] for i in range(a.shape[1])] for a in (top, total, y))
    highest = functools.reduce(jnp.maximum, tops)
    shares = [jnp.exp2(each - highest) for each in tops]
    add = functools.partial(functools.reduce, jnp.add)
    weighted = add([share[..., None] * each for share, each in zip(shares, ys, strict=True)])
    return weighted / add([s * t for s, t in zip(shares, totals, strict=True)])[..., None]


def _call(
    launch: Launch, size: _Size, interpret: bool, _: Any, arrays: Any
) -> tuple[list[jax.Array], list[jax.Array]]:
    """Launch the kernel; return each program's weighted sum, and its logits' top and total.

    The shapes are `[B, P, T, N, H]`, `[B, P, T, N]` and `[B, P, T, N]`.
    """
    from jax.experimental.pallas import triton  # absent from builds without NVIDIA support

    batch, tokens, _, dim = arrays[0].shape
    rows = tokens * size.heads // size.kv_heads
    shape = (batch, size.splits, tokens, size.heads)
    outputs = pl.pallas_call(
        functools.partial(_kernel, launch, size),
        grid=(pl.cdiv(rows, launch.rows), size.kv_heads * size.splits, batch),
        out_shape=[jax.ShapeDtypeStruct(s, jnp.float32) for s in ((*shape, dim), shape, shape)],
        compiler_params=triton.CompilerParams(num_warps=launch.warps, num_stages=1),
        interpret=interpret,
        name="cached_attention",
    )(*arrays)
    return outputs, []


class _Keys(NamedTuple):
    """A block of keys of one batch entry and one key head, all cached or all own."""

    is_own: Any
    """bool."""
    first: Any
    """Index in the mask of the first key of its kind."""
    index: jax.Array
    """[n], counted within its kind."""
    exist: jax.Array
    """bool [n]."""

    @classmethod
    def at(cls, size: _Size, block: Any, width: int) -> "_Keys":
        """Return the block with this number."""
        is_own = jnp.asarray(block >= size.cached_blocks)
        own = is_own.astype(jnp.int32)
        index = (block - own * size.cached_blocks) * width + jnp.arange(width)
        # The number of own or of cached keys, without a branch on the traced `is_own`.
        exist = index < size.cached + own * (size.own - size.cached)
        return cls(is_own, own * size.cached, index, exist)

    def load(self, size: _Size, tokens_ref: Any, cache_refs: Any, batch: Any, head: Any) -> list:
        """Load keys and values, [n, H] each; 0 beyond the last."""
        index, exist = self.index[:, None], self.exist[:, None]
        column = jnp.arange(tokens_ref.shape[-1])[None]

        def own() -> list[jax.Array]:
            heads = (size.heads + head, size.heads + size.kv_heads + head)
            return [load(tokens_ref, (batch, index, h, column), exist) for h in heads]

        def cached() -> list[jax.Array]:
            return [load(ref, (batch, index, head, column), exist) for ref in cache_refs]

        # A branch, not a select: only one of the two is read from memory.
        return jax.lax.cond(self.is_own, own, cached) if size.own else cached()


def _kernel(
    launch: Launch,
    size: _Size,
    tokens_ref: Any,
    mask_ref: Any,
    keys_ref: Any,
    values_ref: Any,
    y_ref: Any,
    top_ref: Any,
    total_ref: Any,
) -> None:
    """Attend from one block of rows to some blocks of keys (online softmax)."""
    batch, group, dim = pl.program_id(2), size.heads // size.kv_heads, y_ref.shape[-1]
    kv_head, split = pl.program_id(1) // size.splits, pl.program_id(1) % size.splits
    # The query heads of one key head are rows of one block, so that they share its keys.
    row = pl.program_id(0) * launch.rows + jnp.arange(launch.rows)
    token, head = row // group, kv_head * group + row % group
    exists = token < tokens_ref.shape[1]
    q_at = (batch, token[:, None], head[:, None], jnp.arange(dim)[None])
    q = load(tokens_ref, q_at, exists[:, None])

    def block(i: Any, state: tuple) -> tuple:
        top, total, y = state
        keys = _Keys.at(size, split * size.per_program + i, launch.keys)
        k, v = keys.load(size, tokens_ref, (keys_ref, values_ref), batch, kv_head)
        mask_at = (batch, token[:, None], (keys.first + keys.index)[None])
        is_attended = load(mask_ref, mask_at, exists[:, None] & keys.exist[None]) != 0
        logits = jnp.where(is_attended, matmul(q, k, (1, 1)) * LOG2_E, MASKED)
        logits = jnp.where(keys.exist[None], logits, -jnp.inf)
        # Online softmax: scale what has been summed so far down to the new maximum.
        new_top = jnp.maximum(top, logits.max(1))
        weights, rescale = jnp.exp2(logits - new_top[:, None]), jnp.exp2(top - new_top)
        y = rescale[:, None] * y + matmul(weights.astype(v.dtype), v, (1, 0))
        return new_top, rescale * total + weights.sum(1), y

    zeros = jnp.zeros(launch.rows, jnp.float32)
    # Below every logit, but finite: -inf minus -inf would be NaN.
    state = (zeros + 2 * MASKED, zeros, jnp.zeros((launch.rows, dim), jnp.float32))
    count = jnp.minimum(size.blocks - split * size.per_program, size.per_program)
    top, total, y = jax.lax.fori_loop(0, count, block, state)
    # Unnormalized: `_combine` needs the maximum and the total of every split.
    at = (batch, split, token, head)
    store(top_ref, at, top, exists)
    store(total_ref, at, total, exists)
    store(y_ref, (batch, split, *q_at[1:]), y, exists[:, None])
