"""A run in several processes: what each does alone, and where they wait for one another.

All train; the first one alone collects, evaluates, prints and writes. The folder of runs must be
one that all of them see. With one process nothing here does anything.
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
from lorasp_jax.training.distributed.meeting import PATIENCE, Meeting

_LONGEST_WAIT = 24 * 3600 * 1000  # ms; the first process may collect and evaluate for hours
_NAMES = ("JAX_NUM_PROCESSES", "JAX_PROCESS_ID")
_VERSIONED = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "mujoco", "mujoco-mjx")
_FAILED = "ended by an error, its traceback is in its output"

_others: peers.Peers | None = None


def initialize(console: Console, advice: str) -> None:
    """Join the other processes; before JAX starts its backend.

    From then on all of them end when one does, unless all have finished. JAX finds the address
    itself under Slurm, Open MPI, Kubernetes and on TPU pods. Elsewhere JAX_COORDINATOR_ADDRESS
    (host:port of the first process), JAX_NUM_PROCESSES and JAX_PROCESS_ID say it.

    Args:
        console: where the first process says whom it waits for.
        advice: what to do when another one is gone.

    Raises:
        ValueError: nothing says where the others are, they cannot be reached, or another one runs
            other versions.
    """
    global _others  # noqa: PLW0603
    address, count, number = _whereabouts()
    if number == 0:
        listener = peers.listen(address)
        console.print(f"waiting for {count} processes at {address}", highlight=False)
        Meeting(listener, address, count, advice)
    _others = peers.Peers(address, number, count, _say, advice)
    _others.agree("versions", _versions())
    if os.environ.get("JAX_PLATFORMS") == "cpu":
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.config.update("jax_enable_preemption_service", False)  # signals are `interrupt`'s
    jax.distributed.initialize(address, count, number)
    _abort_slowly()
    atexit.register(_others.leave, 0)  # before JAX, which waits for the others
    sys.excepthook = _fail


def _whereabouts() -> tuple[str, int, int]:
    """The address where all meet, how many they are, and this one's number.

    Raises:
        ValueError: nothing says it, or something wrong.
    """
    try:
        count, number = (int(os.environ[name]) if name in os.environ else None for name in _NAMES)
        address, count, number, _ = _compat.find_processes(
            os.environ.get("JAX_COORDINATOR_ADDRESS"), count, number, None, None, int(PATIENCE)
        )
        if address is None or count is None or number is None:
            raise ValueError("nothing says where they are")
    except (ValueError, RuntimeError) as error:
        raise ValueError(
            "--distributed found no other processes: start it by Slurm, Open MPI or on a TPU pod, "
            f"or set JAX_COORDINATOR_ADDRESS, {' and '.join(_NAMES)} ({error})"
        ) from error
    if not 0 <= number < count:
        raise ValueError(f"JAX_PROCESS_ID must be 0 to {count - 1}, got {number}")
    return address, count, number


def _versions() -> dict[str, str]:
    """What must be the same for all to compute the same."""
    found = {name: importlib.metadata.version(name) for name in _VERSIONED}
    sources = hashlib.sha256()
    for package in ("envs", "lorasp_jax"):
        spec = importlib.util.find_spec(package)
        folder = Path(str(spec and spec.origin)).parent
        for file in sorted(folder.rglob("*.py")):
            sources.update(f"{file.relative_to(folder)}\n".encode() + file.read_bytes())
    return found | {"source of lorasp_jax": sources.hexdigest()[:12]}


def _abort_slowly() -> None:
    """Give a process that JAX aborts, because the first one is gone, the time to say so.

    A handler of SIGABRT in Python would never run. C's `sleep` may be one, as it is safe in signal
    handlers: it is called with the signal's number, 6, for seconds. JAX's own ways end the same
    (tried with 0.10.2 and 0.12): `jax_enable_recoverability` concerns the deaths of others than the
    first, and the client's `missed_heartbeat_callback` ends in std::bad_cast before it is called.
    """
    library = ctypes.CDLL(None)
    library.signal.argtypes = (ctypes.c_int, ctypes.c_void_p)
    library.signal(signal.SIGABRT, ctypes.cast(library.sleep, ctypes.c_void_p))


def agree(topic: str, facts: Mapping[str, Any]) -> None:
    """Wait until all processes have said the same.

    Args:
        topic: what the facts are, in the plural.
        facts: JSON values by name; values may be such mappings again.

    Raises:
        ValueError: another process says something else.
    """
    if _others is not None:
        _others.agree(topic, facts)


class LastWords(Console):
    """Where a process says why it ends; of several, the first one says it for all."""

    def print(self, *objects: Any, **options: Any) -> None:
        """As rich has it."""
        if _others is not None:
            _others.give_way()
            _others.last_words = " ".join(map(str, objects))
        if _others is None or _others.number == 0:
            super().print(*objects, **options)


def leave(code: int) -> NoReturn:
    """End this process at once, with all its threads, and the others with it."""
    sys.stdout.flush()
    sys.stderr.flush()
    if _others is not None:
        _others.leave(code)
    os._exit(code)


def _say(text: str) -> None:
    """Print what was heard of the others."""
    errors = Console(stderr=True)
    errors.show_cursor()  # which a progress bar hides
    errors.print(text, style="red", soft_wrap=True, highlight=False, markup=False)


def _fail(
    kind: type[BaseException], error: BaseException, traceback: TracebackType | None
) -> NoReturn:
    """End by an error that nobody caught; JAX would wait for the others first."""
    if _others is not None:
        _others.give_way()
        _others.last_words = _FAILED
    sys.__excepthook__(kind, error, traceback)
    leave(1)


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
