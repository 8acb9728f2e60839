"""Run row-wise kernels on arrays whose rows are sharded over devices.

A kernel is opaque to XLA, which would gather all rows on every device. With a sharding rule
(jax.experimental.custom_partitioning), each device runs the kernel on its own rows, for any mesh
shape and axis names.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.custom_batching import custom_vmap
from jax.experimental.custom_partitioning import custom_partitioning
from jax.sharding import NamedSharding, PartitionSpec

Arrays = Sequence[jax.Array]
Kernel = Callable[[Arrays, Arrays], tuple[Arrays, Arrays]]


def by_rows(kernel: Kernel, shared: Arrays, arrays: Arrays) -> tuple[Arrays, Arrays]:
    """Run the kernel on each device's own rows.

    Under `jax.vmap`, every device processes all rows. No gradient is defined.

    Args:
        kernel: (shared, arrays) -> (outputs, sums). Row i of the outputs depends only on row i of
            the arrays. The sums of all devices are added up.
        shared: replicated arrays of any shape.
        arrays: each [T, ...], sharded over T.

    Returns:
        outputs, each [T, ...] and sharded like the arrays; and sums of any shape.
    """
    num_shared = len(shared)

    @jax.jit  # traced once for both uses
    def flat(*operands: jax.Array) -> tuple[Arrays, Arrays]:
        return kernel(operands[:num_shared], operands[num_shared:])

    @custom_vmap
    def call(*operands: jax.Array) -> tuple[Arrays, Arrays]:
        results = jax.eval_shape(flat, *operands)
        partitioned = custom_partitioning(flat)
        partitioned.def_partition(
            lambda mesh, operands, results: _partition(flat, num_shared, mesh, operands, results),
            sharding_rule=_rule(num_shared, operands, *results),
        )
        return partitioned(*operands)

    @call.def_vmap
    def _(size: int, batched: Sequence[bool], *operands: jax.Array) -> Any:
        axes = [0 if is_batched else None for is_batched in batched]
        results = jax.vmap(flat, in_axes=axes, axis_size=size)(*operands)
        return results, jax.tree.map(lambda _: True, results)

    return call(*shared, *arrays)


def _partition(flat: Callable, num_shared: int, mesh: Any, operands: Any, results: Any) -> tuple:
    """Return the per-device function and the shardings of results and operands."""
    first = operands[num_shared]
    axes = first.sharding.spec[0]
    names = axes if isinstance(axes, tuple) else () if axes is None else (axes,)
    if first.shape[0] % math.prod(mesh.shape[name] for name in names):
        names = ()  # otherwise XLA pads the shards, and the sums include the padding
    rows, replicated = (NamedSharding(mesh, PartitionSpec(axes)) for axes in (names or None, None))

    def own_rows(*operands: jax.Array) -> tuple[Arrays, Arrays]:
        outputs, sums = flat(*operands)
        return outputs, jax.lax.psum(sums, names) if names else sums

    outputs, sums = results
    out_shardings = jax.tree.map(lambda _: rows, outputs), jax.tree.map(lambda _: replicated, sums)
    in_shardings = tuple(replicated if i < num_shared else rows for i in range(len(operands)))
    return mesh, own_rows, out_shardings, in_shardings


def _rule(num_shared: int, operands: Arrays, outputs: Arrays, sums: Arrays) -> str:
    """Return the sharding rule, such as "c0, rows c1 -> rows c2, c3": only rows are sharded."""
    others = (f"c{i}" for i in itertools.count())

    def axes(array: jax.Array, *, has_rows: bool) -> str:
        return " ".join(["rows"] * has_rows + [next(others) for _ in array.shape[has_rows:]])

    left = [axes(array, has_rows=i >= num_shared) for i, array in enumerate(operands)]
    right = [axes(a, has_rows=True) for a in outputs] + [axes(a, has_rows=False) for a in sums]
    return f"{', '.join(left)} -> {', '.join(right)}"
