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


def frozen_sharding(array: Any, mesh: Mesh, minimum: int = MINIMUM_SHARDED_BYTES) -> NamedSharding:
    """Split the largest divisible axis of a large array over "fsdp", replicate small ones."""
    fsdp = mesh.shape["fsdp"]
    divisible = [axis for axis, size in enumerate(array.shape) if size % fsdp == 0]
    if fsdp == 1 or not divisible or array.size * array.dtype.itemsize < minimum:
        return replicated(mesh)
    largest = max(divisible, key=lambda axis: array.shape[axis])
    spec: list[str | None] = [None] * array.ndim
    spec[largest] = "fsdp"
    return NamedSharding(mesh, PartitionSpec(*spec))


def place_frozen(frozen: Any, mesh: Mesh, minimum: int = MINIMUM_SHARDED_BYTES) -> Any:
    """Put the frozen base on the mesh, large arrays split over "fsdp"."""
    shardings = jax.tree.map(lambda array: frozen_sharding(array, mesh, minimum), frozen)
    return jax.device_put(frozen, shardings)
