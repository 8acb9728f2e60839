"""Kernels that work row by row, on arrays whose rows lie on several devices.

XLA cannot look into a kernel: it would gather all rows on every device and run it there on all of
them. With a rule (jax.experimental.custom_partitioning) each device runs the kernel on the rows it
has, however the mesh is made and whatever its axes are called.
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
    """What the kernel makes of the arrays, each device running it on its own rows.

    Under `jax.vmap` every device runs it on all rows. No gradient is defined.

    Args:
      kernel: (shared, arrays) -> (outputs, sums). Row i of the outputs depends on row i of the
        arrays alone, and the sums add up over rows.
      shared: of any shape.
      arrays: [T, .] each.

    Returns:
      outputs [T, .], and sums of any shape.
    """
    count = len(shared)

    def flat(*operands: jax.Array) -> tuple[Arrays, Arrays]:
        return kernel(operands[:count], operands[count:])

    @custom_vmap
    def call(*operands: jax.Array) -> tuple[Arrays, Arrays]:
        found = jax.eval_shape(flat, *operands)
        partitioned = custom_partitioning(flat)
        partitioned.def_partition(
            lambda mesh, operands, found: _partition(flat, count, mesh, operands, found),
            sharding_rule=_rule(count, operands, *found),
        )
        return partitioned(*operands)

    @call.def_vmap
    def _(size: int, batched: Sequence[bool], *operands: jax.Array) -> Any:
        axes = [0 if is_batched else None for is_batched in batched]
        found = jax.vmap(flat, in_axes=axes, axis_size=size)(*operands)
        return found, jax.tree.map(lambda _: True, found)

    return call(*shared, *arrays)


def _partition(flat: Callable, count: int, mesh: Any, operands: Any, found: Any) -> tuple:
    """Where operands and results lie, and what a device does with its part of them."""
    first = operands[count]
    axes = first.sharding.spec[0]
    names = axes if isinstance(axes, tuple) else () if axes is None else (axes,)
    if first.shape[0] % math.prod(mesh.shape[name] for name in names):
        names = ()  # the devices' shares would be filled up with rows that are none
    rows, whole = (NamedSharding(mesh, PartitionSpec(axes)) for axes in (names or None, None))

    def own_rows(*operands: jax.Array) -> tuple[Arrays, Arrays]:
        outputs, sums = flat(*operands)
        return outputs, jax.lax.psum(sums, names) if names else sums

    outputs, sums = found
    placed = jax.tree.map(lambda _: rows, outputs), jax.tree.map(lambda _: whole, sums)
    return mesh, own_rows, placed, tuple(whole if i < count else rows for i in range(len(operands)))


def _rule(count: int, operands: Arrays, outputs: Arrays, sums: Arrays) -> str:
    """ "c0, rows c1 -> rows c2, c3": rows go with rows, whatever lies along the other axes."""
    others = (f"c{i}" for i in itertools.count())

    def axes(array: jax.Array, *, has_rows: bool) -> str:
        return " ".join(["rows"] * has_rows + [next(others) for _ in array.shape[has_rows:]])

    left = [axes(array, has_rows=i >= count) for i, array in enumerate(operands)]
    right = [axes(a, has_rows=True) for a in outputs] + [axes(a, has_rows=False) for a in sums]
    return f"{', '.join(left)} -> {', '.join(right)}"
