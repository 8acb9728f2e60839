"""A run in several processes: what each does alone, and where they wait for one another.

All train; the first one alone collects, evaluates, prints and writes. The folder of runs must be
one that all of them see. With one process nothing here does anything.
"""

import contextlib
import os
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

_LONGEST_WAIT = 24 * 3600 * 1000  # ms; the first process may collect and evaluate for hours


def initialize() -> None:
    """Join the other processes; before JAX starts its backend.

    JAX finds them itself under Slurm, Open MPI, Kubernetes and on TPU pods. Elsewhere
    JAX_COORDINATOR_ADDRESS (host:port of the first process), JAX_NUM_PROCESSES and JAX_PROCESS_ID
    say it.

    Raises:
        ValueError: nothing says where the others are, or they cannot be reached.
    """
    names = {"num_processes": "JAX_NUM_PROCESSES", "process_id": "JAX_PROCESS_ID"}
    try:
        given: Any = {
            key: int(os.environ[name]) for key, name in names.items() if name in os.environ
        }
        if os.environ.get("JAX_PLATFORMS") == "cpu":
            jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(**given)
    except (ValueError, RuntimeError) as error:
        raise ValueError(
            "--distributed found no other processes: start it by Slurm, Open MPI or on a TPU pod, "
            f"or set JAX_COORDINATOR_ADDRESS, {' and '.join(names.values())} ({error})"
        ) from error


def is_first() -> bool:
    """Whether this process is the one that prints and writes."""
    return jax.process_index() == 0


def wait(name: str) -> None:
    """Wait until all processes are here; on the host, as devices do not wait for hours."""
    import orbax.checkpoint as ocp

    ocp.multihost.get_barrier_sync_fn()(key=name, timeout_ms=_LONGEST_WAIT)


@contextlib.contextmanager
def first_goes_ahead(name: str) -> Iterator[None]:
    """The first process runs this block, then all others do, which find what it wrote."""
    if not is_first():
        wait(name)
    yield
    if is_first():
        wait(name)


def anywhere(flag: bool) -> bool:
    """Whether the flag is up in any process."""
    if jax.process_count() == 1:
        return flag
    return bool(multihost_utils.process_allgather(np.array(flag)).any())


def put(tree: Any, shardings: Any) -> Any:
    """Arrays that every process holds, on the devices of all of them.

    Args:
        tree: of arrays, equal in all processes.
        shardings: of each array, or one of all.
    """
    if jax.process_count() == 1:
        return jax.device_put(tree, shardings)
    if isinstance(shardings, jax.sharding.Sharding):
        return jax.tree.map(lambda array: _spread(array, shardings), tree)
    return jax.tree.map(_spread, tree, shardings)


def _spread(array: Any, sharding: jax.sharding.Sharding) -> jax.Array:
    whole = np.asarray(array)
    return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])


def own(tree: Any) -> Any:
    """Arrays that lie on the devices of all processes, whole on each one's first device."""
    return jax.tree.map(_whole, tree) if jax.process_count() > 1 else tree


def _whole(array: Any) -> Any:
    if not isinstance(array, jax.Array) or array.is_fully_addressable:
        return array
    if array.is_fully_replicated:
        return array.addressable_data(0)
    return jax.device_put(multihost_utils.process_allgather(array, tiled=True))
