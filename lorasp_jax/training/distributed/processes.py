"""Multi-process runs: startup, barriers, shared arrays and coordinated exit.

All processes train; only the first one collects, evaluates, prints and writes. The runs folder must
be on storage that they share. The functions also work in a single process.
"""

import atexit
import contextlib
import ctypes
import hashlib
import importlib.metadata
import importlib.util
import os
import signal
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

import jax
import numpy as np
from jax.experimental import multihost_utils
from rich.console import Console

from lorasp_jax import _compat
from lorasp_jax.training.distributed import peers
from lorasp_jax.training.distributed.rendezvous import JOIN_TIMEOUT, Rendezvous

_BARRIER_TIMEOUT = 24 * 3600 * 1000  # ms; the first process may collect and evaluate for hours
_VARIABLES = ("JAX_NUM_PROCESSES", "JAX_PROCESS_ID")
_PACKAGES = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "mujoco", "mujoco-mjx")
_UNCAUGHT = "failed with an exception; see its output for the traceback"

_peers: peers.Peers | None = None


def initialize(console: Console, hint: str) -> None:
    """Connect to the other processes; call this before JAX starts its backend.

    From then on, if one process fails, all exit. JAX finds the address by itself under Slurm, Open
    MPI and Kubernetes and on TPU pods. Elsewhere set JAX_COORDINATOR_ADDRESS (host:port of the
    first process), JAX_NUM_PROCESSES and JAX_PROCESS_ID.

    `hint` is a remedy, printed if another process dies.

    Raises:
        ValueError: the environment does not describe the processes, they cannot be reached, or
            their versions differ.
    """
    global _peers  # noqa: PLW0603
    address, count, number = _cluster_info()
    if number == 0:
        listener = peers.listen(address)
        console.print(f"waiting for {count} processes at {address}", highlight=False)
        Rendezvous(listener, address, count, hint)
    _peers = peers.Peers(address, number, count, _say, hint)
    _peers.agree("versions", _versions())
    if os.environ.get("JAX_PLATFORMS") == "cpu":
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.config.update("jax_enable_preemption_service", False)  # `interrupt` handles signals
    jax.distributed.initialize(address, count, number)
    _delay_abort()
    atexit.register(_peers.announce_exit, 0)  # before JAX's handler, which waits for the others
    sys.excepthook = _exit_on_exception


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
            os.environ.get("JAX_COORDINATOR_ADDRESS"), count, number, None, None, int(JOIN_TIMEOUT)
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
    return address, count, number


def _versions() -> dict[str, str]:
    """Return what must match in all processes: package versions and a hash of the source."""
    versions = {name: importlib.metadata.version(name) for name in _PACKAGES}
    sources = hashlib.sha256()
    for package in ("envs", "lorasp_jax"):
        spec = importlib.util.find_spec(package)
        folder = Path(str(spec and spec.origin)).parent
        for file in sorted(folder.rglob("*.py")):
            sources.update(f"{file.relative_to(folder)}\n".encode() + file.read_bytes())
    return versions | {"source of lorasp_jax": sources.hexdigest()[:12]}


def _delay_abort() -> None:
    """Delay JAX's SIGABRT after the coordinator is lost, so that the cause is reported first.

    Python signal handlers do not run during abort(), so the handler is C's `sleep`, which is
    async-signal-safe. It is called with the signal number, 6, and therefore sleeps 6 s.

    JAX's own options do not help (tested with 0.10.2 and 0.12). `jax_enable_recoverability` does
    not cover a failure of the first process. The client's `missed_heartbeat_callback` fails with
    std::bad_cast before it is called.
    """
    library = ctypes.CDLL(None)
    library.signal.argtypes = (ctypes.c_int, ctypes.c_void_p)
    library.signal(signal.SIGABRT, ctypes.cast(library.sleep, ctypes.c_void_p))


def agree(topic: str, facts: Mapping[str, Any]) -> None:
    """Wait until all processes have reported equal facts (see `Peers.agree`).

    Raises:
        ValueError: the facts of another process differ.
    """
    if _peers is not None:
        _peers.agree(topic, facts)


class ExitConsole(Console):
    """Console that records what it prints as the exit reason; only the first process prints."""

    def print(self, *objects: Any, **options: Any) -> None:
        """See `rich.console.Console.print`."""
        if _peers is not None:
            _peers.wait_for_root_cause()
            _peers.exit_reason = " ".join(map(str, objects))
        if _peers is None or _peers.number == 0:
            super().print(*objects, **options)


def exit_all(code: int) -> NoReturn:
    """Exit without waiting for this process's threads, and make the other processes exit."""
    sys.stdout.flush()
    sys.stderr.flush()
    if _peers is not None:
        _peers.announce_exit(code)
    os._exit(code)


def _say(text: str) -> None:
    errors = Console(stderr=True)
    errors.show_cursor()  # a progress bar may have hidden it
    errors.print(text, style="red", soft_wrap=True, highlight=False, markup=False)


def _exit_on_exception(
    kind: type[BaseException], error: BaseException, traceback: TracebackType | None
) -> NoReturn:
    """Exit at once on an uncaught exception; without this, JAX waits for the other processes."""
    if _peers is not None:
        _peers.wait_for_root_cause()
        _peers.exit_reason = _UNCAUGHT
    sys.__excepthook__(kind, error, traceback)
    exit_all(1)


def is_first() -> bool:
    """Whether this is the first process, which prints and writes."""
    return jax.process_index() == 0


def barrier(name: str) -> None:
    """Wait on the host for all processes; a collective on the devices would time out."""
    import orbax.checkpoint as ocp

    ocp.multihost.get_barrier_sync_fn()(key=name, timeout_ms=_BARRIER_TIMEOUT)


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
