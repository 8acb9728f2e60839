"""Utilities shared by all benchmarks: timing, machine description, compact tables."""

import importlib.metadata
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table


def best(call: Callable[[], Any], *, calls: int = 1, repeats: int = 3) -> float:
    """Queue `calls` calls; return seconds per call, the best of `repeats` after two warm-ups."""
    seconds = []
    for _ in range(2 + repeats):
        start = time.perf_counter()
        jax.block_until_ready([call() for _ in range(calls)])
        seconds.append((time.perf_counter() - start) / calls)
    return min(seconds[2:])


def machine(*packages: str) -> str:
    """Describe device, cores and package versions."""
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in packages)
    device = jax.devices()[0].device_kind
    return f"{device}, {os.cpu_count()} cores, Python {platform.python_version()}, {versions}"


def random_weights(shapes: Any, place: Callable[[np.ndarray], Any] = jnp.asarray) -> Any:
    """Fill shapes of weights with noise on the host, one at a time, and `place` them.

    A program on the device would have to be compiled for each shape.
    """
    normal = np.random.default_rng(0).standard_normal(2**20 + 7, np.float32)

    def fill(leaf: jax.ShapeDtypeStruct) -> Any:
        is_code = jnp.issubdtype(leaf.dtype, jnp.integer)
        block = (normal * (40 if is_code else 0.02)).astype(np.int8 if is_code else leaf.dtype)
        return place(np.resize(block.astype(leaf.dtype), leaf.shape))

    return jax.tree.map(fill, shapes)


def warp_mib(backend: str) -> float:
    """Return the device memory that Warp has allocated, in MiB; 0 for other engines."""
    if backend != "warp" or jax.default_backend() != "gpu":
        return 0.0
    import warp

    return warp.get_mempool_used_mem_current(warp.get_device()) / 2**20


def write_json(path: Path | None, results: dict[str, Any]) -> None:
    """Write results to a file, if one is given."""
    if path:
        path.write_text(json.dumps(results, indent=1))


def print_table(console: Console, rows: list[dict[str, Any]], title: str = "") -> None:
    """Print one line per row, with narrow columns."""
    table = Table(title=title, box=None, padding=(0, 1, 0, 0))
    for name in rows[0]:
        table.add_column(escape(name), no_wrap=True, justify="right")
    for row in rows:
        table.add_row(*map(text, row.values()))
    console.print(table)


def text(value: Any) -> str:
    """Format a value; floats get three significant digits."""
    if not isinstance(value, float):
        return str(value)
    for size, letter in ((1e6, " M"), (1e3, " k")):
        if value >= size:
            return f"{value / size:.3g}{letter}"
    return f"{value:.3g}"
