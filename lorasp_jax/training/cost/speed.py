"""How fast a run trains, what it waits for and what memory it holds, by log interval.

Nothing here waits for the device: an interval ends where its metrics were read anyway.
"""

import contextlib
import time
from collections.abc import Iterator
from typing import Any

import jax

from lorasp_jax.training.cost import flops
from lorasp_jax.training.cost.preflight import GIB


class Speed:
    """The clock of a run; it stands still between two intervals, and while a program compiles."""

    def __init__(self, batch_size: int, operations: float | None) -> None:
        """Not yet begun.

        Args:
            batch_size: windows a step, over all devices.
            operations: floating-point operations a step, over all devices; None: not counted.
        """
        self._batch_size, self._operations = batch_size, operations
        self._began: float | None = None
        self._waited: float | None = None

    def begin(self) -> None:
        """Start the clock, unless it runs."""
        if self._began is None:
            self._began = time.perf_counter()

    @contextlib.contextmanager
    def waiting(self, results: Any) -> Iterator[None]:
        """In this block the host waits for the next batch.

        The time counts if the device has nothing left to do at the end of it: until then it still
        works on what the host gave it ahead.

        Args:
            results: any tree of arrays of the last step that the device was given.
        """
        began = time.perf_counter()
        yield
        idle = all(array.is_ready() for array in jax.tree.leaves(results))
        self._waited = (self._waited or 0.0) + idle * (time.perf_counter() - began)

    def end(self, steps: int) -> dict[str, float]:
        """Stop the clock after so many steps, and give what is known of them.

        Returns:
            `speed/samples_per_second`; `speed/flop_utilisation`, where operations are counted and
            the device's peak is known; `speed/data_wait`, share of the time in which the device
            waited for data, of runs that stream or replace them; `memory/in_use_gib` and
            `memory/peak_gib` of the first device of this process, where it reports them.
        """
        assert self._began is not None
        seconds = time.perf_counter() - self._began
        found = {"speed/samples_per_second": steps * self._batch_size / seconds}
        if self._operations is not None:
            share = flops.utilisation(steps * self._operations / jax.device_count(), seconds)
            found |= {} if share is None else {"speed/flop_utilisation": share}
        if self._waited is not None:
            found["speed/data_wait"] = self._waited / seconds
        self._began = self._waited = None
        return found | memory()


def memory() -> dict[str, float]:
    """Memory in use and its highest so far [GiB]; nothing where the device does not report it."""
    stats = jax.local_devices()[0].memory_stats() or {}
    names = {"memory/in_use_gib": "bytes_in_use", "memory/peak_gib": "peak_bytes_in_use"}
    return {name: stats[key] / GIB for name, key in names.items() if key in stats}
