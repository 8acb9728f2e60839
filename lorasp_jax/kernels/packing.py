"""Many small arrays as one."""

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
class InARow:
    """A tree of fp32 arrays as one array, which costs a kernel, and XLA before it, one step."""

    values: jax.Array
    """All numbers, [N], or [n, N] of n such trees."""
    structure: Any
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, tree: Any, axes: int = 0) -> "InARow":
        """The tree, whose leaves have so many leading axes, or what is in a row already."""
        if isinstance(tree, cls):
            return tree
        leaves, structure = jax.tree.flatten(tree)
        flat = [leaf.reshape(*leaf.shape[:axes], -1) for leaf in leaves]
        shapes = tuple(leaf.shape[axes:] for leaf in leaves)
        return cls(jnp.concatenate(flat, axis=-1), structure, shapes)

    def tree(self, part: Callable[[int, int], jax.Array] | None = None) -> Any:
        """The tree; `part`, (start, size) -> [..., size], says how a stretch of the row is read."""
        read = part or (lambda start, size: self.values[..., start : start + size])
        parts = [read(*place) for place in places(tuple(map(math.prod, self.shapes)))]
        leaves = [
            p.reshape(*p.shape[:-1], *shape) for p, shape in zip(parts, self.shapes, strict=True)
        ]
        return jax.tree.unflatten(self.structure, leaves)


def places(widths: tuple[int, ...]) -> list[tuple[int, int]]:
    """(start, width) of columns side by side."""
    return list(zip(itertools.accumulate(widths[:-1], initial=0), widths, strict=True))
