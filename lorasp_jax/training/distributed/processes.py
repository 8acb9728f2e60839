"""Multi-process runs: startup, barriers, shared arrays and exit.

All processes train; only the first one collects, evaluates, prints and writes. The runs folder must
be on storage that they share. The functions also work in a single process.
"""

import concurrent.futures
import contextlib
import functools
import json
import os
import platform
import socket
import sys
import threading
from collections.abc import Iterator, Mapping
from typing import Any, NoReturn

import jax
import numpy as np
from jax.experimental import multihost_utils
from rich.console import Console

from lorasp_jax.training import _compat
from lorasp_jax.training.demonstrations import in_thread

_JOIN_TIMEOUT = 180  # s
_EXIT_TIMEOUT = 60  # s; after it, JAX aborts the others if a process has died or waits to exit
_BARRIER_TIMEOUT = 24 * 3600 * 1000  # ms; the first process may collect and evaluate for hours
_VARIABLES = ("JAX_NUM_PROCESSES", "JAX_PROCESS_ID")
_MAX_FACTS = 2**16  # bytes
_LEAVING = "lorasp_jax_leaving"
"""Folder of the exit codes of processes that leave before the others."""
_POLL = 1  # s
_connected = threading.Event()


def initialize(console: Console) -> None:
    """Connect to the other processes; call this before JAX starts its backend.

    From then on, if one process fails, JAX ends all within a minute. JAX finds the address by
    itself under Slurm, Open MPI and Kubernetes and on TPU pods. Elsewhere set
    JAX_COORDINATOR_ADDRESS (host:port of the first process), JAX_NUM_PROCESSES and JAX_PROCESS_ID.

    Raises:
        ValueError: the environment does not describe the processes, or the port is in use.
    """
    address, count, number = _cluster_info()
    if number == 0:
        _check_port(address)
        wait = f"waiting for {count} processes at {address}, up to {_JOIN_TIMEOUT} s"
        console.print(wait, highlight=False, soft_wrap=True)
    if os.environ.get("JAX_PLATFORMS") == "cpu":
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.config.update("jax_enable_preemption_service", False)  # `interrupt` handles signals
    connect = functools.partial(
        jax.distributed.initialize,
        initialization_timeout=_JOIN_TIMEOUT,
        heartbeat_timeout_seconds=_EXIT_TIMEOUT,
        shutdown_timeout_seconds=_EXIT_TIMEOUT,
    )
    in_thread(connect, address, count, number).result()  # signals do not interrupt C++
    _connected.set()


def _cluster_info() -> tuple[str, int, int]:
    """Return the coordinator's address, the number of processes and the index of this one.

    Raises:
        ValueError: the environment does not define them, or is invalid.
    """
    try:
        count, number = (
            int(os.environ[name]) if name in os.environ else None for name in _VARIABLES
        )
        address, count, number, _ = _compat.find_processes(
            os.environ.get("JAX_COORDINATOR_ADDRESS"), count, number, None, None, _JOIN_TIMEOUT
        )
        if address is None or count is None or number is None:
            raise ValueError("no coordinator address")
    except (ValueError, RuntimeError) as error:
        raise ValueError(
            "--distributed found no launcher: use Slurm, Open MPI, Kubernetes or a TPU pod, or set "
            f"JAX_COORDINATOR_ADDRESS, {' and '.join(_VARIABLES)} ({error})"
        ) from error
    if not 0 <= number < count:
        raise ValueError(f"JAX_PROCESS_ID must be between 0 and {count - 1}, got {number}")
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise ValueError(
            f"JAX_COORDINATOR_ADDRESS must be host:port, such as 10.0.0.1:1234, got {address!r}"
        )
    return address, count, number


def _check_port(address: str) -> None:
    """Raise ValueError if the port of `address` is in use on this host: JAX would crash."""
    port = int(address.rpartition(":")[2])
    dual = socket.has_dualstack_ipv6()
    family = socket.AF_INET6 if dual else socket.AF_INET
    try:
        socket.create_server(("", port), family=family, dualstack_ipv6=dual).close()
    except OSError as error:
        raise ValueError(
            f"port {port} on {platform.node()} is not available ({error.strerror}): choose "
            "another one in JAX_COORDINATOR_ADDRESS or, under Slurm, in JAX_COORDINATOR_PORT"
        ) from error


@contextlib.contextmanager
def together() -> Iterator[None]:
    """Stop all processes if the block fails in one of them; that one says why.

    Raises:
        SystemExit: the block failed in another process.
    """
    failure = None
    try:
        yield
    except (ValueError, OSError, SystemExit) as error:
        failure = error
    connected = jax.distributed.is_initialized()  # otherwise do not start JAX's backend yet
    failed = connected and any_process(failure is not None)
    if failure:
        raise failure
    if failed:
        raise SystemExit(2)


def agree(topic: str, facts: Mapping[str, Any]) -> None:
    """Stop all processes unless they have the same facts, JSON values by name.

    Raises:
        ValueError: this process has other facts than the first one.
    """
    if not jax.distributed.is_initialized():
        return
    text = np.frombuffer(json.dumps(facts).encode().ljust(_MAX_FACTS), np.uint8)
    first = json.loads(bytes(multihost_utils.broadcast_one_to_all(text)))
    with together():
        own = json.loads(bytes(text))
        if names := [name for name in {*first, *own} if first.get(name) != own.get(name)]:
            raise ValueError(
                f"process {jax.process_index()} has other {topic} than the first process "
                f"({', '.join(sorted(names))}): use the same ones in all processes"
            )


def exit_all(code: int) -> NoReturn:
    """Exit without waiting for this process's threads, but for the other processes.

    Those that wait at a barrier, or come to one, exit with the same code.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    if _connected.is_set():  # JAX would wait for a connection that is under way
        shared = _compat.coordination
        shared.client.key_value_set(f"{_LEAVING}/{shared.process_id}", str(code))
        jax.distributed.shutdown()
    os._exit(code)


def is_first() -> bool:
    """Whether this is the first process, which prints and writes."""
    return jax.process_index() == 0


def barrier(name: str) -> None:
    """Wait on the host for all processes; a collective on the devices would time out.

    Exit if another process exits instead of coming here.
    """
    if jax.process_count() == 1:
        return
    import orbax.checkpoint as ocp

    wait = functools.partial(ocp.multihost.get_barrier_sync_fn(), timeout_ms=_BARRIER_TIMEOUT)
    passed = in_thread(lambda: wait(key=name))  # signals do not interrupt C++
    while not concurrent.futures.wait([passed], _POLL).done:
        for _, code in _compat.coordination.client.key_value_dir_get(_LEAVING):
            exit_all(int(code))
    passed.result()


@contextlib.contextmanager
def first_process_first(name: str) -> Iterator[None]:
    """Run the block in the first process, then in the others, which can read the first's files."""
    if not is_first():
        barrier(name)
    yield
    if is_first():
        barrier(name)


def any_process(flag: bool) -> bool:
    """Whether `flag` is true in any process."""
    if jax.process_count() == 1:
        return flag
    return bool(multihost_utils.process_allgather(np.array(flag)).any())


def device_put(tree: Any, shardings: Any) -> Any:
    """Place a pytree of arrays, equal in all processes, on the devices of all processes.

    `shardings` is one sharding for all arrays or a pytree with one for each.
    """
    if jax.process_count() == 1:
        return jax.device_put(tree, shardings)
    if isinstance(shardings, jax.sharding.Sharding):
        return jax.tree.map(lambda array: _to_global(array, shardings), tree)
    return jax.tree.map(_to_global, tree, shardings)


def _to_global(array: Any, sharding: jax.sharding.Sharding) -> jax.Array:
    host = np.asarray(array)
    return jax.make_array_from_callback(host.shape, sharding, lambda index: host[index])


def to_local(tree: Any) -> Any:
    """Gather arrays sharded over all processes onto the first device of each process."""
    return jax.tree.map(_gather, tree) if jax.process_count() > 1 else tree


def _gather(array: Any) -> Any:
    if not isinstance(array, jax.Array) or array.is_fully_addressable:
        return array
    if array.is_fully_replicated:
        return array.addressable_data(0)
    return jax.device_put(multihost_utils.process_allgather(array, tiled=True))
