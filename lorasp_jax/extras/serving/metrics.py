"""Counters and latencies of a server, as a text page."""

import threading
from collections import Counter, deque
from collections.abc import Iterable

import numpy as np

WINDOW = 1000
"""Number of recent requests whose latencies are kept."""
COLUMNS = ("mean", "std", "p25", "p50", "p75", "p90", "p95", "p99")
"""As in the table that openpi's example client prints (examples/simple_client/main.py)."""


class Metrics:
    """Thread-safe counters, and the latest latencies by name."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counters: Counter[str] = Counter()
        self._latencies: dict[str, deque[float]] = {}

    def count(self, name: str, number: int = 1) -> None:
        """Add to a counter; a negative number decreases a gauge, such as open connections."""
        with self._lock:
            self._counters[name] += number

    def observe(self, name: str, milliseconds: float) -> None:
        """Record a latency."""
        with self._lock:
            self._latencies.setdefault(name, deque(maxlen=WINDOW)).append(milliseconds)

    def __getitem__(self, name: str) -> int:
        """Return the value of a counter."""
        with self._lock:
            return self._counters[name]

    def page(self) -> str:
        """Return all values as text.

        Counters are lines "name value", which Prometheus reads. The latencies [ms] of the last
        `WINDOW` requests are a table in comment lines.
        """
        with self._lock:
            counters = sorted(self._counters.items())
            latencies = {name: list(values) for name, values in self._latencies.items()}
        lines = [f"lorasp_jax_{name} {value}" for name, value in counters]
        rows = [f"{name:18s} {_row(values)}" for name, values in latencies.items()]
        header = " ".join(f"{column:>8s}" for column in COLUMNS)
        table = [f"# {'latency [ms]':18s} {header}", *(f"# {row}" for row in rows)]
        return "\n".join([*lines, *table, ""])


def summary(values: Iterable[float]) -> list[float]:
    """Return mean, standard deviation and percentiles of latencies, one per column of `COLUMNS`."""
    array = np.fromiter(values, float)
    percentiles = np.percentile(array, [int(column[1:]) for column in COLUMNS[2:]])
    return [float(array.mean()), float(array.std()), *map(float, percentiles)]


def _row(values: Iterable[float]) -> str:
    return " ".join(f"{value:8.2f}" for value in summary(values))
