"""The ("data", "fsdp") device mesh and the shardings of arrays on it.

The training step is written for the global batch. `jax.jit` with `NamedSharding` parallelizes it
over any number of devices; this replaces `pmap` (docs.jax.dev/en/latest/migrate_pmap.html).
"""

import math
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

MINIMUM_SHARDED_BYTES = 4 * 2**20
"""Arrays under 4 MiB are replicated, as in openpi, src/openpi/training/sharding.py:48."""


def make_mesh(fsdp: int = 1, devices: Sequence[Any] | None = None) -> Mesh:
    """Return a mesh over `devices` (default: all) with axes ("data", "fsdp").

    Raises:
        ValueError: the number of devices is not a multiple of `fsdp`.
    """
    devices = jax.devices() if devices is None else devices
    if fsdp < 1 or len(devices) % fsdp:
        raise ValueError(f"fsdp must divide the number of devices ({len(devices)}), got {fsdp}")
    grid = np.asarray(devices).reshape(-1, fsdp)
    return Mesh(grid, ("data", "fsdp"), axis_types=(AxisType.Auto, AxisType.Auto))


def replicated(mesh: Mesh) -> NamedSharding:
    """Return the sharding with the whole array on every device."""
    return NamedSharding(mesh, PartitionSpec())


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """Return the sharding with the leading axis split over all devices."""
    return NamedSharding(mesh, PartitionSpec(("data", "fsdp")))


def batches_sharding(mesh: Mesh) -> NamedSharding:
    """Return `batch_sharding` for batches with a leading axis over steps."""
    return NamedSharding(mesh, PartitionSpec(None, ("data", "fsdp")))


def shardings(tree: Any, mesh: Mesh, minimum: int = MINIMUM_SHARDED_BYTES) -> Any:
    """Return a sharding for each array of a tree: large arrays over "fsdp", the others replicated.

    The longest axis that `fsdp` divides is sharded; arrays under `minimum` bytes are replicated.
    A sharding depends only on shape and dtype, so optimizer moments and averages of parameters are
    sharded like the parameters.
    """

    def sharding(array: Any) -> NamedSharding:
        fsdp, size = mesh.shape["fsdp"], array.size * array.dtype.itemsize
        divisible = [axis for axis, length in enumerate(array.shape) if length % fsdp == 0]
        if fsdp == 1 or not divisible or size < minimum:
            return replicated(mesh)
        longest = max(divisible, key=lambda axis: array.shape[axis])
        names = ("fsdp" if axis == longest else None for axis in range(array.ndim))
        return NamedSharding(mesh, PartitionSpec(*names))

    return jax.tree.map(sharding, tree)


def with_sharding(tree: Any, sharding: jax.sharding.Sharding) -> Any:
    """Return the shapes of arrays, each with this sharding."""
    shape = lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding)  # noqa: E731
    return jax.tree.map(shape, tree)


def bytes_on_device(tree: Any, fsdp: int) -> int:
    """Return the bytes per device of a tree sharded by `shardings`."""
    leaves = [leaf for leaf in jax.tree.leaves(tree) if hasattr(leaf, "dtype")]
    placed = zip(leaves, shardings(leaves, make_mesh(fsdp)), strict=True)
    return sum(math.prod(where.shard_shape(x.shape)) * x.dtype.itemsize for x, where in placed)
