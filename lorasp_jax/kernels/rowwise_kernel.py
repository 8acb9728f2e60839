"""Trace a row-wise function into one GPU kernel, and its gradient into another.

Between its matmuls, an adapter applies a chain of small operations to each token: a nonlinearity, a
gate and losses. XLA compiles the chain to a dozen kernels and stores the residuals of each; a scan
over layers copies them once more. Here the chain is one Triton kernel. The backward kernel
recomputes the chain block by block and applies its VJP. It needs only the input rows and the
function's mask, packed into bits.

The reference is the function itself, applied to all rows at once. On an H200 (35k bf16 rows, 64
directions, router width 32), LoRA-SP's chain and its gradient take 180 us as kernels and 500 us in
XLA.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl

from lorasp_jax.kernels.blocks import Launch
from lorasp_jax.kernels.packing import PackedTree, spans
from lorasp_jax.kernels.rematerialization import save_for_backward
from lorasp_jax.kernels.row_sharding import by_rows

FORWARD = Launch(16, 2, 1056)
BACKWARD = Launch(16, 4, 264)
"""Launch parameters of the two passes, the fastest of about 15 each on an H200."""
FEW, FEW_ROWS = Launch(1, 1, 8192), 1024
"""Launch parameters of both passes for up to FEW_ROWS rows, chosen by hand: one warp per row, for
low latency."""


Columns = list[jax.Array]
"""Column groups [b, width] of a block of b rows, adjacent in one array [b, sum of widths]."""
Widths = tuple[int, ...]


class Operand(NamedTuple):
    """An array [T, ...] and the column groups that each of n functions reads or writes."""

    array: Any
    widths: Widths
    """Widths of the column groups of one function."""
    start: int = 0
    """First column of the first function."""
    stride: int = 0
    """Offset to the columns of the next function; 0 if all functions share the same columns."""

    def spans(self, i: Any) -> list[tuple[Any, int]]:
        """Return (start, width) of each column group of function i."""
        return [(self.start + i * self.stride + at, width) for at, width in spans(self.widths)]


Function = Callable[[Any, Columns, jax.Array, jax.Array | None], tuple]
Body = Callable[..., tuple[list[Columns], Any]]


def rowwise_kernel(
    function: Function,
    shared: PackedTree,
    rows: jax.Array,
    widths: Widths,
    valid: jax.Array,
    *,
    start: int = 0,
    interpret: bool = False,
) -> tuple[jax.Array, Any, Columns]:
    """Apply n functions to all rows, each to its own columns, in one kernel; gradients in another.

    Args:
        function: (shared, columns, valid, mask) -> (output, sums, mask, statistics), on a block of
            b rows. Triton requires dimensions to be powers of two, and at least 16 in a matmul.
            columns: list of [b, width].
            valid: bool [b, 1].
            mask: int32 [b, K] of 0 and 1, K >= 8. The forward pass passes None, and the function
                computes the mask. The backward pass passes this mask as a constant.
            output: [b, O].
            sums: pytree of fp32 arrays, summed over blocks.
            statistics: list of [b, 1], without gradient.
        shared: small fp32 arrays used by every row, a tree for each function, stacked.
        rows: [T, at least start + n * sum(widths)].
        widths: widths of the column groups of one function.
        valid: bool [T, 1], passed to `function`.
        start: first column of `rows` to use.
        interpret: run without a GPU, slowly.

    Returns:
        Output [T, n O], sums with a leading axis n, and the list of statistics, [T, n] each. Output
        and sums are differentiable in `shared` and `rows`.
    """
    launches = (FEW, FEW) if len(rows) <= FEW_ROWS else (FORWARD, BACKWARD)
    static = function, widths, start, launches, interpret
    return _rowwise(static, shared, rows, valid.astype(jnp.int8))


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _rowwise(static: tuple, packed: PackedTree, rows: jax.Array, valid: jax.Array) -> tuple:
    return _run(static, packed, rows, valid, keep_mask=False)[0]


def _forward(static: tuple, packed: PackedTree, rows: jax.Array, valid: jax.Array) -> tuple:
    results, mask = _run(static, packed, rows, valid, keep_mask=True)
    return results, (packed, rows, valid, *mask)


# jit traces and lowers a kernel once for all layers that need the same one.
@functools.partial(jax.jit, static_argnums=0, static_argnames="keep_mask")
def _run(
    static: tuple, packed: PackedTree, rows: jax.Array, valid: jax.Array, *, keep_mask: bool
) -> tuple[tuple, Sequence[jax.Array]]:
    """Return the results of `rowwise_kernel` and, in a list, the bit-packed mask if `keep_mask`."""
    function, widths, start, (launch, _), interpret = static

    def block(shared: Any, columns: Columns, valid: Columns) -> tuple[list[Columns], Any]:
        output, sums, mask, statistics = function(shared, columns, valid[0] != 0, None)
        columns = [output, *statistics, *([_pack_bits(mask)] if keep_mask else [])]
        return [[column] for column in columns], sums

    inputs = [Operand(rows, widths, start, sum(widths)), Operand(valid, (1,))]
    (output, *others), sums = _map_blocks(block, packed, inputs, launch, interpret)
    end = len(others) - keep_mask
    return (output, sums.tree(), others[:end]), others[end:]


@functools.partial(jax.jit, static_argnums=0)
def _backward(static: tuple, residuals: tuple, cotangents: tuple) -> tuple:
    function, widths, start, (_, launch), interpret = static
    packed, rows, valid, mask = residuals
    d_output, d_sums, _ = cotangents

    def block(constants: tuple, columns: Columns, *others: Columns) -> tuple[list[Columns], Any]:
        shared, d_sums = constants
        valid, mask, d_output = (column for (column,) in others)

        def differentiable(shared: Any, columns: Columns) -> tuple:
            return function(shared, columns, valid != 0, _unpack_bits(mask))[:2]

        # Recompute the block instead of storing its residuals; the stored mask saves the search.
        _, vjp = jax.vjp(differentiable, shared, columns)
        d_shared, d_columns = vjp((d_output, d_sums))
        return [d_columns], d_shared

    sizes = [array.shape[1] // len(packed.values) for array in (mask, d_output)]
    inputs = [Operand(rows, widths, start, sum(widths)), Operand(valid, (1,))]
    inputs += [Operand(a, (w,), stride=w) for a, w in zip((mask, d_output), sizes, strict=True)]
    # The gradients of the sums are the same for all rows, as the shared arrays are.
    constants = PackedTree.of((packed.tree(), d_sums), axes=1)
    (d_rows,), d_packed = _map_blocks(block, constants, inputs, launch, interpret)
    # Columns outside the functions' own get no gradient.
    unused = rows.shape[1] - start - d_rows.shape[1]
    return d_packed, jnp.pad(d_rows, ((0, 0), (start, unused))), None


_rowwise.defvjp(_forward, _backward)


class _Blocks(NamedTuple):
    """Body of a kernel and layout of its operands."""

    body: Body
    launch: Launch
    shared_tree: Callable[[Callable], Any]
    inputs: list[Operand]
    outputs: list[Operand]
    """Operands of `inputs` and `outputs` hold dtypes in place of arrays."""
    sums: Any
    """Shapes of the sums over rows."""


def _map_blocks(
    body: Body, shared: PackedTree, inputs: list[Operand], launch: Launch, interpret: bool
) -> tuple[Sequence[jax.Array], PackedTree]:
    """Run body(shared, *input columns) -> (output columns, sums) on all blocks, in one kernel."""
    # The body's results on one block give the layout of all outputs.
    columns, sums = jax.eval_shape(
        lambda values, *columns: body(dataclasses.replace(shared, values=values).tree(), *columns),
        shared.values[0],
        *([_shape(s.array.dtype, launch.rows, width) for width in s.widths] for s in inputs),
    )
    outputs = []
    for output in columns:
        widths = tuple(column.shape[1] for column in output)
        outputs.append(Operand(output[0].dtype, widths, stride=sum(widths)))
    dtypes = [operand._replace(array=operand.array.dtype) for operand in inputs]
    blocks = _Blocks(body, launch, shared.tree, dtypes, outputs, sums)
    call = functools.partial(_call, blocks, interpret)
    found = by_rows(call, [shared.values], [operand.array for operand in inputs])
    results, (totals,) = jax.tree.map(save_for_backward, found)
    leaves, structure = jax.tree.flatten(sums)
    return results, PackedTree(totals, structure, tuple(leaf.shape for leaf in leaves))


def _call(
    blocks: _Blocks, interpret: bool, shared: Sequence[jax.Array], arrays: Sequence[jax.Array]
) -> tuple[list[jax.Array], list[jax.Array]]:
    """Launch the kernel; return the outputs and the packed sums.

    Each program adds up the sums of its own blocks; XLA adds up those of all programs.
    """
    from jax.experimental.pallas import triton  # absent from builds without NVIDIA support

    (values,), launch, num_rows = shared, blocks.launch, len(arrays[0])
    # Whole blocks only; padded rows are not valid, so they add nothing to the sums.
    arrays = [jnp.pad(array, ((0, -num_rows % launch.rows), (0, 0))) for array in arrays]
    num_blocks, num_functions = len(arrays[0]) // launch.rows, len(values)
    programs = min(launch.programs, num_blocks)
    size = sum(leaf.size for leaf in jax.tree.leaves(blocks.sums))
    rows = [_shape(o.array, len(arrays[0]), num_functions * sum(o.widths)) for o in blocks.outputs]
    outputs, partial_sums = pl.pallas_call(
        functools.partial(_kernel, blocks, num_blocks, programs),
        grid=(programs, num_functions),
        out_shape=(rows, _shape(jnp.float32, programs, num_functions, size)),
        compiler_params=triton.CompilerParams(num_warps=launch.warps, num_stages=1),
        interpret=interpret,
        name="rowwise_kernel",
    )(values, arrays)
    # All sums share one array, so that XLA reduces them in one kernel.
    return [output[:num_rows] for output in outputs], [partial_sums.sum(0)]


def _pack_bits(mask: jax.Array) -> jax.Array:
    """Pack 0 and 1, int32 [n, K], into bits, uint8 [n, K / 8]."""
    rows, width = mask.shape
    # Bit b of byte j is entry b K/8 + j, so that a sum over an axis packs the bits.
    bits = mask.reshape(rows, 8, width // 8)
    return jax.lax.shift_left(bits, _bit_numbers(bits)).sum(1, dtype=jnp.int32).astype(jnp.uint8)


def _unpack_bits(packed: jax.Array) -> jax.Array:
    """Unpack 0 and 1, int32 [n, K], from bits, uint8 [n, K / 8]."""
    rows, width = packed.shape
    bits = jnp.broadcast_to(packed.astype(jnp.int32)[:, None, :], (rows, 8, width))
    return (jax.lax.shift_right_logical(bits, _bit_numbers(bits)) & 1).reshape(rows, -1)


def _bit_numbers(bits: jax.Array) -> jax.Array:
    return jax.lax.broadcasted_iota(jnp.int32, bits.shape, 1)


def _shape(dtype: Any, *shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, dtype)


def _kernel(
    blocks: _Blocks,
    num_blocks: int,
    programs: int,
    shared_ref: Any,
    input_refs: Any,
    output_refs: Any,
    sum_ref: Any,
) -> None:
    """Run one program: every `programs`-th block of one function."""
    program, function = pl.program_id(0), pl.program_id(1)
    # Loaded once, before the loop over the program's blocks.
    shared = blocks.shared_tree(lambda *span: shared_ref[function, pl.ds(*span)])
    num_rows = blocks.launch.rows

    def block(i: jax.Array, sums: Any) -> Any:
        # Programs take blocks in turn, so that their numbers of blocks differ by one at most.
        at = pl.ds((program + i * programs) * num_rows, num_rows)
        loaded = [
            [ref[at, pl.ds(*span)] for span in operand.spans(function)]
            for ref, operand in zip(input_refs, blocks.inputs, strict=True)
        ]
        outputs, block_sums = blocks.body(shared, *loaded)
        for ref, operand, columns in zip(output_refs, blocks.outputs, outputs, strict=True):
            for span, column in zip(operand.spans(function), columns, strict=True):
                ref[at, pl.ds(*span)] = column
        return jax.tree.map(jnp.add, sums, block_sums)

    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), blocks.sums)
    # Sums stay in registers until the last block: no atomics, and the order is fixed.
    count = pl.cdiv(num_blocks - program, programs)
    leaves = jax.tree.leaves(jax.lax.fori_loop(0, count, block, zeros))
    for span, leaf in zip(spans(tuple(leaf.size for leaf in leaves)), leaves, strict=True):
        sum_ref[program, function, pl.ds(*span)] = leaf.reshape(-1)
