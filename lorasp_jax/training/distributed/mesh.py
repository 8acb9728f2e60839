"""The ("data", "fsdp") device mesh and where each array lives on it.

One code path for one device and for many: the step is written for the global batch, `jax.jit`
with `NamedSharding` does the rest. This is what "pmap'd training" means on today's JAX
(docs.jax.dev/en/latest/migrate_pmap.html).
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

MINIMUM_SHARDED_BYTES = 4 * 2**20
"""Arrays under 4 MiB are replicated, as in openpi, src/openpi/training/sharding.py:48."""


def make_mesh(fsdp: int = 1, devices: Sequence[Any] | None = None) -> Mesh:
    """A mesh over `devices` (default: all) with axes ("data", "fsdp").

    Raises:
        ValueError: the number of devices is not a multiple of `fsdp`.
    """
    devices = jax.devices() if devices is None else devices
    if fsdp < 1 or len(devices) % fsdp:
        raise ValueError(f"fsdp = {fsdp} does not divide the {len(devices)} devices of this run")
    grid = np.asarray(devices).reshape(-1, fsdp)
    return Mesh(grid, ("data", "fsdp"), axis_types=(AxisType.Auto, AxisType.Auto))


def replicated(mesh: Mesh) -> NamedSharding:
    """Every device holds the whole array."""
    return NamedSharding(mesh, PartitionSpec())


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """The leading axis is split over all devices."""
    return NamedSharding(mesh, PartitionSpec(("data", "fsdp")))


def split_axis(shape: Sequence[int], size: int, fsdp: int, minimum: int) -> int | None:
    """The axis of an array of `size` bytes that is split over `fsdp` devices; None: it is whole.

    The largest that can be, of an array of at least `minimum` bytes.
    """
    divisible = [axis for axis, length in enumerate(shape) if length % fsdp == 0]
    if fsdp == 1 or not divisible or size < minimum:
        return None
    return max(divisible, key=lambda axis: shape[axis])


def shardings(tree: Any, mesh: Mesh, minimum: int = MINIMUM_SHARDED_BYTES) -> Any:
    """Where each array of a tree lies: large ones split over "fsdp", others on every device.

    It follows from shapes alone, so that moments and averages lie as their parameters do.
    """

    def place(array: Any) -> NamedSharding:
        size, spec = array.size * array.dtype.itemsize, [None] * array.ndim
        axis = split_axis(array.shape, size, mesh.shape["fsdp"], minimum)
        names = ("fsdp" if axis == own else None for own, _ in enumerate(spec))
        return NamedSharding(mesh, PartitionSpec(*names) if axis is not None else PartitionSpec())

    return jax.tree.map(place, tree)


def bytes_on_device(tree: Any, fsdp: int, minimum: int = MINIMUM_SHARDED_BYTES) -> float:
    """What one device holds of a tree that lies as `shardings` says."""

    def held(array: Any) -> float:
        size = array.size * array.dtype.itemsize
        whole = split_axis(array.shape, size, fsdp, minimum) is None
        return size if whole else size / fsdp

    leaves = [leaf for leaf in jax.tree.leaves(tree) if hasattr(leaf, "dtype")]
    return float(sum(held(leaf) for leaf in leaves))
