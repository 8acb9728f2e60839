"""A row-wise function as one GPU kernel, its gradient as another.

What an adapter computes between its matrix products is a chain of small steps on each token: a
nonlinearity, a gate, losses. XLA makes a dozen kernels of it, stores what each leaves for the
backward pass, and within a scan over depth copies all of that once more. Here the chain is traced
into one Triton kernel; the backward kernel computes a block's chain again and pulls its cotangents
back, so that only the chain's input and the bits that the function asks to keep are stored.

The reference is the function itself, applied to all rows at once. LoRA-SP's chain and its gradient
on an H200 (35k bf16 rows, R = 64, H = 32): 180 us, 500 us in XLA.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl

from lorasp_jax.kernels.packing import InARow, places
from lorasp_jax.kernels.row_sharding import by_rows


class Launch(NamedTuple):
    """How rows are spread over the GPU."""

    rows: int
    """Rows to a block: 1, or at least 16, the smallest that Triton's matrix product takes."""
    warps: int
    """Warps to a program."""
    programs: int
    """About how many programs share the blocks; each leaves one partial sum."""


FORWARD = Launch(16, 2, 816)
BACKWARD = Launch(16, 4, 512)
FEW, FEW_ROWS = Launch(1, 1, 8192), 1024
"""Both ways for up to so many rows, where what counts is how long one takes: a warp to a row."""


Columns = list[jax.Array]
"""Arrays [n, width] that lie side by side in one [n, sum of widths]."""
Widths = tuple[int, ...]


class Side(NamedTuple):
    """An array [T, ...] and where in it n functions find the columns they take."""

    array: Any
    widths: Widths
    """Of the columns of one function."""
    start: int = 0
    """Where those of the first function begin."""
    stride: int = 0
    """How much further those of the next; 0: all take the same."""

    def places(self, i: Any) -> list[tuple[Any, int]]:
        """(start, width) of each of the i-th function's columns."""
        return [(self.start + i * self.stride + at, size) for at, size in places(self.widths)]


Function = Callable[[Any, Columns, jax.Array, jax.Array | None], tuple]
Body = Callable[..., tuple[list[Columns], Any]]


def fused_rows(
    function: Function,
    shared: Any,
    rows: jax.Array,
    widths: Widths,
    counts: jax.Array,
    *,
    start: int = 0,
    interpret: bool = False,
) -> tuple[jax.Array, Any, Columns]:
    """`function` of all rows in one kernel, its gradient in another.

    With n trees in `shared` it is n functions, each of the next columns of `rows`.

    Args:
      function: (shared, columns, counts, kept) -> (output, sums, kept, statistics), for n rows, one
        or a power of two: columns [n, width] each, counts bool [n, 1], output [n, O]; sums is a
        pytree of fp32 arrays that add up over rows, kept, bool [n, K], K at least 8, what its
        gradient takes as given (None on the way forward), statistics a list of [n, 1] without
        gradient. It may use what Triton has: sides are powers of two, in a matrix product at
        least 16.
      shared: pytree of small fp32 arrays that every row uses, or the same as `InARow`, or n of it.
      rows: [T, sum of widths, n times, or more].
      widths: of the columns that `function` takes.
      counts: bool [T, 1].
      start: which column is the first.
      interpret: run the kernels' bodies without a GPU, slowly.

    Returns:
      output [T, O], sums, statistics [T, 1]. Gradients reach `shared` and `rows`. With n trees in
      `shared` [T, n O], sums with a leading axis n, and [T, n].
    """
    launches = (FEW, FEW) if len(rows) <= FEW_ROWS else (FORWARD, BACKWARD)
    row, counts = InARow.of(shared), counts.astype(jnp.int8)
    alone = row.values.ndim == 1
    row = dataclasses.replace(row, values=jnp.atleast_2d(row.values))
    found: Any = _fused((function, widths, start, launches, interpret), row, rows, counts)
    output, sums, statistics = found
    return output, jax.tree.map(lambda leaf: leaf[0], sums) if alone else sums, statistics


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _fused(static: tuple, row: InARow, rows: jax.Array, counts: jax.Array) -> tuple:
    return _results(static, row, rows, counts, keeps=False)[0]


def _forward(static: tuple, row: InARow, rows: jax.Array, counts: jax.Array) -> tuple:
    results, kept = _results(static, row, rows, counts, keeps=True)
    return results, (row, rows, counts, *kept)


def _results(
    static: tuple, row: InARow, rows: jax.Array, counts: jax.Array, *, keeps: bool
) -> tuple[tuple, Sequence[jax.Array]]:
    """What `fused_rows` returns; [what its gradient takes as given] or []."""
    function, widths, start, (launch, _), interpret = static

    def block(shared: Any, columns: Columns, counts: Columns) -> tuple[list[Columns], Any]:
        output, sums, kept, statistics = function(shared, columns, counts[0] != 0, None)
        columns = [output, *statistics, *([_packed(kept)] if keeps else [])]
        return [[column] for column in columns], sums

    inputs = [Side(rows, widths, start, sum(widths)), Side(counts, (1,))]
    (output, *others), sums = _map_blocks(block, row, inputs, launch, interpret)
    end = len(others) - keeps
    return (output, sums.tree(), others[:end]), others[end:]


def _backward(static: tuple, residuals: tuple, cotangents: tuple) -> tuple:
    function, widths, start, (_, launch), interpret = static
    row, rows, counts, kept = residuals
    d_output, d_sums, _ = cotangents

    def block(given: tuple, columns: Columns, *others: Columns) -> tuple[list[Columns], Any]:
        shared, d_sums = given
        counts, kept, d_output = (column for (column,) in others)

        def differentiable(shared: Any, columns: Columns) -> tuple:
            return function(shared, columns, counts != 0, _unpacked(kept))[:2]

        _, pull_back = jax.vjp(differentiable, shared, columns)
        d_shared, d_columns = pull_back((d_output, d_sums))
        return [d_columns], d_shared

    each = [array.shape[1] // len(row.values) for array in (kept, d_output)]
    inputs = [Side(rows, widths, start, sum(widths)), Side(counts, (1,))]
    inputs += [Side(a, (w,), stride=w) for a, w in zip((kept, d_output), each, strict=True)]
    given = InARow.of((row.tree(), d_sums), axes=1)
    (d_rows,), d_row = _map_blocks(block, given, inputs, launch, interpret)
    behind = rows.shape[1] - start - d_rows.shape[1]
    return d_row, jnp.pad(d_rows, ((0, 0), (start, behind))), None


_fused.defvjp(_forward, _backward)


class _Blocks(NamedTuple):
    """What the kernel does with a block of rows, and where it finds and leaves its columns."""

    body: Body
    launch: Launch
    shared_tree: Callable[[Callable], Any]
    inputs: list[Side]
    outputs: list[Side]
    """Both with the arrays' types in place of the arrays."""
    sums: Any
    """Shapes of what adds up over rows."""


def _map_blocks(
    body: Body, shared: InARow, inputs: list[Side], launch: Launch, interpret: bool
) -> tuple[Sequence[jax.Array], InARow]:
    """body(shared, columns of each input) -> (columns of each output, sums), in one kernel."""
    columns, sums = jax.eval_shape(
        lambda values, *columns: body(dataclasses.replace(shared, values=values).tree(), *columns),
        shared.values[0],
        *([_shape(s.array.dtype, launch.rows, width) for width in s.widths] for s in inputs),
    )
    outputs = []
    for output in columns:
        widths = tuple(column.shape[1] for column in output)
        outputs.append(Side(output[0].dtype, widths, stride=sum(widths)))
    types = [side._replace(array=side.array.dtype) for side in inputs]
    blocks = _Blocks(body, launch, shared.tree, types, outputs, sums)
    call = functools.partial(_call, blocks, interpret)
    found, (added,) = by_rows(call, [shared.values], [side.array for side in inputs])
    leaves, structure = jax.tree.flatten(sums)
    return found, InARow(added, structure, tuple(leaf.shape for leaf in leaves))


def _call(
    blocks: _Blocks, interpret: bool, shared: Sequence[jax.Array], arrays: Sequence[jax.Array]
) -> tuple[list[jax.Array], list[jax.Array]]:
    """Outputs, and the sums in a row.

    Every program takes a stretch of one function's blocks and adds up their sums; XLA adds up the
    programs'.
    """
    from jax.experimental.pallas import triton  # absent from builds without NVIDIA support

    (values,), launch, num_rows = shared, blocks.launch, len(arrays[0])
    arrays = [jnp.pad(array, ((0, -num_rows % launch.rows), (0, 0))) for array in arrays]
    number, num = len(arrays[0]) // launch.rows, len(values)
    most = pl.cdiv(number, launch.programs)
    stretch = next(n for n in range(most, 0, -1) if number % n == 0)
    programs, size = number // stretch, sum(leaf.size for leaf in jax.tree.leaves(blocks.sums))
    rows = [_shape(s.array, len(arrays[0]), num * sum(s.widths)) for s in blocks.outputs]
    outputs, partial_sums = pl.pallas_call(
        functools.partial(_kernel, blocks, stretch),
        grid=(programs, num),
        out_shape=(rows, _shape(jnp.float32, programs, num, size)),
        compiler_params=triton.CompilerParams(num_warps=launch.warps, num_stages=1),
        interpret=interpret,
        name="fused_rows",
    )(values, arrays)
    # One array of all sums: XLA adds it up in one kernel for all.
    return [output[:num_rows] for output in outputs], [partial_sums.sum(0)]


def _packed(kept: jax.Array) -> jax.Array:
    """Bools [n, K] as bits, uint8 [n, K / 8]."""
    rows, width = kept.shape
    bits = kept.astype(jnp.int32).reshape(rows, 8, width // 8)
    return jax.lax.shift_left(bits, _bit_numbers(bits)).sum(1, dtype=jnp.int32).astype(jnp.uint8)


def _unpacked(packed: jax.Array) -> jax.Array:
    """The bools [n, K] of `_packed`."""
    rows, width = packed.shape
    bits = jnp.broadcast_to(packed.astype(jnp.int32)[:, None, :], (rows, 8, width))
    return (jax.lax.shift_right_logical(bits, _bit_numbers(bits)) & 1).reshape(rows, -1) != 0


def _bit_numbers(bits: jax.Array) -> jax.Array:
    return jax.lax.broadcasted_iota(jnp.int32, bits.shape, 1)


def _shape(dtype: Any, *sides: int) -> jax.ShapeDtypeStruct:
    """An array without content."""
    return jax.ShapeDtypeStruct(sides, dtype)


def _kernel(
    blocks: _Blocks, stretch: int, shared_ref: Any, input_refs: Any, output_refs: Any, sum_ref: Any
) -> None:
    """One program: `stretch` blocks of one function, one after the other."""
    program, function = pl.program_id(0), pl.program_id(1)
    shared = blocks.shared_tree(lambda *place: shared_ref[function, pl.ds(*place)])
    num_rows = blocks.launch.rows

    def block(i: jax.Array, sums: Any) -> Any:
        at = pl.ds((program * stretch + i) * num_rows, num_rows)
        loaded = [
            [ref[at, pl.ds(*place)] for place in side.places(function)]
            for ref, side in zip(input_refs, blocks.inputs, strict=True)
        ]
        found, more = blocks.body(shared, *loaded)
        for ref, side, columns in zip(output_refs, blocks.outputs, found, strict=True):
            for place, column in zip(side.places(function), columns, strict=True):
                ref[at, pl.ds(*place)] = column
        return jax.tree.map(jnp.add, sums, more)

    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), blocks.sums)
    leaves = jax.tree.leaves(jax.lax.fori_loop(0, stretch, block, zeros))
    for place, leaf in zip(places(tuple(leaf.size for leaf in leaves)), leaves, strict=True):
        sum_ref[program, function, pl.ds(*place)] = leaf.reshape(-1)
