"""One process that times one program on one workload and writes the result to a file.

Every program has a module with a function `measure`, which yields a row per measurement:

    python -m benchmarks.peers.qwix --table stack-nf4 --variant "LoRA on nf4" --result result.json

This module needs only the standard library.
"""

import argparse
import dataclasses
import importlib.metadata
import json
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

GIB = 2**30


@dataclasses.dataclass(frozen=True)
class Job:
    """What a process measures, and for how long."""

    table: str
    variant: str
    size: Any
    warmup: int
    """Calls before the first timed one."""
    steps: int
    """Timed calls."""
    compile: bool
    """Whether programs in PyTorch use `torch.compile`."""
    denoise_steps: list[int]
    """Numbers of denoising steps to sample with."""


Row = dict[str, Any]


def timed(item: str, call: Callable[[], Any], wait: Callable[[Any], Any], job: Job) -> Row:
    """Time single calls, each until the device has finished.

    Args:
        item: what is measured, the same words in every program.
        call: one training step or one forward pass.
        wait: waits until the result of `call` is ready.
        job: the numbers of warm-up and timed calls.

    Returns:
        The item, and the median, shortest and longest time [s].
    """
    seconds = []
    for _ in range(job.warmup + job.steps):
        start = time.perf_counter()
        wait(call())
        seconds.append(time.perf_counter() - start)
    seconds = seconds[job.warmup :]
    middle = statistics.median(seconds)
    return {"item": item, "median_s": middle, "min_s": min(seconds), "max_s": max(seconds)}


def sampled(batch: int, denoise_steps: int) -> str:
    """Name the item of a sampled batch."""
    return f"batch {batch}, {denoise_steps} denoising steps"


def version(name: str) -> str:
    """Return a package's version, with the commit if it was installed from a repository."""
    try:
        package = importlib.metadata.distribution(name)
    except importlib.metadata.PackageNotFoundError:
        return getattr(sys.modules.get(name), "__version__", "unknown")
    origin = json.loads(package.read_text("direct_url.json") or "{}")
    commit = origin.get("vcs_info", {}).get("commit_id", "")[:8]
    return f"{package.version} ({commit})" if commit else package.version


def main(
    measure: Callable[[Job], Iterator[Row]], device: Callable[[], str], packages: tuple[str, ...]
) -> None:
    """Run one job from the command line.

    Args:
        measure: yields the rows of a job.
        device: names the device after the measurement.
        packages: distributions whose versions go into the result.
    """
    parser = argparse.ArgumentParser()
    parser.add_argument("--table", required=True)
    parser.add_argument("--variant", required=True)
    parser.add_argument("--size", default="base")
    parser.add_argument("--warmup", type=int, default=5)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--compile", action="store_true")
    parser.add_argument("--denoise-steps", type=int, nargs="+", default=[10])
    parser.add_argument("--result", type=Path, required=True)
    options = vars(parser.parse_args())
    result: Path = options.pop("result")
    rows = list(measure(Job(**options)))
    versions = {"python": platform.python_version(), **{name: version(name) for name in packages}}
    result.write_text(json.dumps({"device": device(), "versions": versions, "rows": rows}))


def jax_device() -> str:
    """Name JAX's first device."""
    import jax

    return jax.devices()[0].device_kind


def jax_peak_gib() -> float | None:
    """Return the most device memory that JAX has used in this process [GiB]; None on a CPU."""
    import jax

    stats = jax.devices()[0].memory_stats()
    return stats["peak_bytes_in_use"] / GIB if stats else None
