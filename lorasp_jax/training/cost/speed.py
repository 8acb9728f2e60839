"""Throughput, data wait and memory use per log interval.

Nothing here waits for the device; the loop has already done so by reading the interval's metrics.
"""

import contextlib
import time
from collections.abc import Iterator
from typing import Any

import jax

from lorasp_jax.config import Config
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.training.cost import flops, preflight
from lorasp_jax.training.cost.preflight import GIB


class Speed:
    """Meter of training speed, paused between intervals and during compilation."""

    def __init__(self, batch_size: int, step_flops: float | None) -> None:
        """Create a meter that has not started.

        `batch_size` and `step_flops` are windows and FLOPs per step over all devices. None means
        that FLOPs are not counted.
        """
        self._batch_size, self._step_flops = batch_size, step_flops
        self._start: float | None = None
        self._wait: float | None = None

    @classmethod
    def of(cls, config: Config, backbone: BackboneConfig) -> "Speed":
        """Create the meter of a run; FLOPs are counted only if the device's peak is known."""
        known = flops.peak() is not None
        return cls(
            config.optim.batch_size, preflight.step_flops(config, backbone) if known else None
        )

    def begin(self) -> None:
        """Start the clock unless it is running."""
        if self._start is None:
            self._start = time.perf_counter()

    @contextlib.contextmanager
    def waiting(self, results: Any) -> Iterator[None]:
        """Measure the time in this block, in which the host waits for the next batch.

        The time counts only if the device is idle at the end of the block, that is, if the
        `results` of the last dispatched step are ready.
        """
        start = time.perf_counter()
        yield
        idle = all(array.is_ready() for array in jax.tree.leaves(results))
        self._wait = (self._wait or 0.0) + idle * (time.perf_counter() - start)

    def end(self, steps: int) -> dict[str, float]:
        """Stop the clock after `steps` steps and return the metrics of the interval.

        - `speed/samples_per_second`: windows per second over all devices.
        - `speed/flop_utilisation`: fraction of the device's peak FLOP/s, if known.
        - `speed/data_wait`: fraction of the time in which the device waited for data, if data was
          streamed or replaced.
        - `memory/in_use_gib`, `memory/peak_gib`: see `memory`.
        """
        assert self._start is not None
        seconds = time.perf_counter() - self._start
        metrics = {"speed/samples_per_second": steps * self._batch_size / seconds}
        if self._step_flops is not None:
            share = flops.utilization(steps * self._step_flops / jax.device_count(), seconds)
            metrics |= {} if share is None else {"speed/flop_utilisation": share}
        if self._wait is not None:
            metrics["speed/data_wait"] = self._wait / seconds
        self._start = self._wait = None
        return metrics | memory()


def memory() -> dict[str, float]:
    """Return current and peak memory use of the first local device [GiB], or {} if unknown."""
    stats = jax.local_devices()[0].memory_stats() or {}
    names = {"memory/in_use_gib": "bytes_in_use", "memory/peak_gib": "peak_bytes_in_use"}
    return {name: stats[key] / GIB for name, key in names.items() if key in stats}
