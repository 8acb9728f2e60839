"""The ("data", "fsdp") device mesh and the shardings of arrays on it.

The training step is written for the global batch. `jax.jit` with `NamedSharding` parallelizes it
over any number of devices; this replaces `pmap` (docs.jax.dev/en/latest/migrate_pmap.html).
"""

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


def split_axis(shape: Sequence[int], size: int, fsdp: int, minimum: int) -> int | None:
    """Return the axis to shard over `fsdp` devices, or None to replicate the array.

    The longest axis divisible by `fsdp` is sharded. Arrays of `size` < `minimum` bytes are
    replicated.
    """
    divisible = [axis for axis, length in enumerate(shape) if length % fsdp == 0]
    if fsdp == 1 or not divisible or size < minimum:
        return None
    return max(divisible, key=lambda axis: shape[axis])


def shardings(tree: Any, mesh: Mesh, minimum: int = MINIMUM_SHARDED_BYTES) -> Any:
    """Return a sharding for each array of a tree: large arrays over "fsdp", the others replicated.

    A sharding depends only on shape and dtype, so optimizer moments and averages of parameters are
    sharded like the parameters.
    """

    def sharding(array: Any) -> NamedSharding:
        size = array.size * array.dtype.itemsize
        axis = split_axis(array.shape, size, mesh.shape["fsdp"], minimum)
        names = ("fsdp" if i == axis else None for i in range(array.ndim))
        return NamedSharding(mesh, PartitionSpec(*names) if axis is not None else PartitionSpec())

    return jax.tree.map(sharding, tree)


def bytes_on_device(tree: Any, fsdp: int, minimum: int = MINIMUM_SHARDED_BYTES) -> float:
    """Return the bytes per device of a tree sharded by `shardings`."""

    def local_bytes(array: Any) -> float:
        size = array.size * array.dtype.itemsize
        is_whole = split_axis(array.shape, size, fsdp, minimum) is None
        return size if is_whole else size / fsdp

    leaves = [leaf for leaf in jax.tree.leaves(tree) if hasattr(leaf, "dtype")]
    return float(sum(local_bytes(leaf) for leaf in leaves))
