"""Pack many small arrays into one."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


@functools.partial(
    jax.tree_util.register_dataclass, data_fields=["values"], meta_fields=["structure", "shapes"]
)
@dataclasses.dataclass(frozen=True)
class PackedTree:
    """A pytree of fp32 arrays in one flat array: one operand of a kernel, one copy in XLA."""

    values: jax.Array
    """Concatenated leaves: [N], or [n, N] for n stacked trees."""
    structure: Any
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, tree: Any, axes: int = 0) -> "PackedTree":
        """Pack a tree whose leaves share `axes` leading axes."""
        leaves, structure = jax.tree.flatten(tree)
        flat = [leaf.reshape(*leaf.shape[:axes], -1) for leaf in leaves]
        shapes = tuple(leaf.shape[axes:] for leaf in leaves)
        return cls(jnp.concatenate(flat, axis=-1), structure, shapes)

    def tree(self, load: Callable[[int, int], jax.Array] | None = None) -> Any:
        """Unpack; `load(start, size)` -> [..., size], if given, replaces slicing."""
        load = load or (lambda start, size: self.values[..., start : start + size])
        parts = [load(*span) for span in spans(tuple(map(math.prod, self.shapes)))]
        leaves = [
            p.reshape(*p.shape[:-1], *shape) for p, shape in zip(parts, self.shapes, strict=True)
        ]
        return jax.tree.unflatten(self.structure, leaves)


def spans(widths: tuple[int, ...]) -> list[tuple[int, int]]:
    """Return each group's (start, width) for adjacent column groups of these widths."""
    return list(zip(itertools.accumulate(widths[:-1], initial=0), widths, strict=True))
