"""Counts and latencies as Prometheus reads them, in its text format 0.0.4."""

import bisect
from collections import defaultdict
from collections.abc import Container, Mapping, Sequence

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
SECONDS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Bounds of buckets of durations [s]; our choice."""
RANKS = tuple(map(float, (1, 2, 4, 8, 16, 32, 64, 128)))
"""The same of mean active ranks."""
_GAUGES = ("open_connections",)


class Histogram:
    """Durations, or other values, by adapter."""

    def __init__(self, bounds: Sequence[float] = SECONDS) -> None:
        """Begin without any; `bounds` are ascending."""
        self._bounds = bounds
        self._counts: dict[str, list[int]] = defaultdict(lambda: [0] * (len(bounds) + 1))
        self._sums: dict[str, float] = defaultdict(float)

    def observe(self, adapter: str, value: float) -> None:
        """Add a value, such as a duration [s]."""
        self._counts[adapter][bisect.bisect_left(self._bounds, value)] += 1
        self._sums[adapter] += value

    def keep(self, adapters: Container[str]) -> None:
        """Forget all other adapters."""
        for adapter in [*self._counts]:
            if adapter not in adapters:
                del self._counts[adapter], self._sums[adapter]

    def lines(self, name: str) -> list[str]:
        """Return the series; buckets are cumulative."""
        lines = [f"# TYPE {name} histogram"]
        for adapter, counts in list(self._counts.items()):
            label, total = f'adapter="{_escape(adapter)}"', 0
            for bound, count in zip((*self._bounds, "+Inf"), list(counts), strict=True):
                total += count
                lines.append(f'{name}_bucket{{{label},le="{bound}"}} {total}')
            lines.append(f"{name}_sum{{{label}}} {self._sums[adapter]:.6f}")
            lines.append(f"{name}_count{{{label}}} {total}")
        return lines


def text(
    counts: Mapping[str, int], histograms: Mapping[str, Histogram], adapters: Container[str]
) -> str:
    """Return all series of a server, and forget those of adapters that it no longer has.

    Args:
        counts: of `PolicyServer`.
        histograms: by what they measure, such as request_seconds.
        adapters: those of the server.
    """
    lines = []
    for name, value in list(counts.items()):
        full = f"lorasp_jax_{name}" if name in _GAUGES else f"lorasp_jax_{name}_total"
        lines += [f"# TYPE {full} {'gauge' if name in _GAUGES else 'counter'}", f"{full} {value}"]
    for name, histogram in histograms.items():
        histogram.keep(adapters)
        lines += histogram.lines(f"lorasp_jax_{name}")
    return "\n".join(lines) + "\n"


def _escape(label: str) -> str:
    return label.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
