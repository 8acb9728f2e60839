"""Training on small GPUs: memory and speed with JAX's allocator limited to 12, 16 and 24 GB.

    python -m benchmarks.small_cards --json small_cards.jsonl
    python -m benchmarks.small_cards --json small_cards.jsonl --only "whole run" LoRA-SP
    python -m benchmarks.small_cards --json small_cards.jsonl --sizes nano nano_pi05    # on a CPU

Each row is a process of its own whose allocator has what `--fit` leaves of the GPU. Several compile
side by side; one at a time is timed: training's loop of steps, with random weights as they are
stored and a batch that is on the device. Rows with a batch of 32 have what `--fit` chooses; the
others show storage, micro-batches and rematerialization. One row is a whole run, `train.py --fit
12GB`: it loads a checkpoint in bf16, trains and measures held-out episodes; its speed is that
beside others. Rows that are in the file already are left out, unless they failed.

Memory [GiB]: "expected" by the estimate, in training and evaluating; "planned" by XLA, with
arguments; "peak" of the allocator; "in use" and "peak before" at the first step of a whole run.
"""

import argparse
import dataclasses
import fcntl
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from rich.console import Console

from benchmarks.backbones import Step
from benchmarks.measuring import best, print_table, random_weights
from lorasp_jax import peft
from lorasp_jax.adapters import adaptation
from lorasp_jax.config import Config, DataConfig, ModelConfig, OptimConfig
from lorasp_jax.training.base import base_model, sized
from lorasp_jax.training.cost import fit, preflight
from lorasp_jax.training.cost.dry_run import planned_bytes
from lorasp_jax.training.cost.preflight import GIB

LIMITS = ("12GB", "16GB", "24GB")
METHODS = {
    # The layers of openpi's LoRA, both transformers.
    "LoRA": (peft.LoRA(rank=16, alpha=16.0), ("openpi",)),
    "LoRA-SP": (peft.LoRASP(rank=128), ("all-linear",)),
}
LOOP = 2
"""Steps per call."""


def table(sizes: list[str]) -> list[dict[str, Any]]:
    """Return the settings of all rows, the most important first."""
    pi0, pi05 = sizes
    four = {"size": pi05, "method": "LoRA", "limit": "12GB", "batch": 4}
    stored = [
        four | {"limit": "16GB", "base": base, "remat": "products", "parts": 1}
        for base in ("nf4", "float8", "int8")
    ]
    fitted = [
        {"size": size, "method": method, "limit": limit, "batch": 32}
        for size in (pi05, pi0)
        for limit in LIMITS
        for method in METHODS
    ]
    parts = [four | {"base": "nf4", "remat": "products", "parts": parts} for parts in (2, 4)]
    remats = [four | {"base": "nf4", "remat": remat, "parts": 1} for remat in ("narrow", "full")]
    return [*stored, *fitted, *parts, *remats]


def run_configs(row: dict[str, Any]) -> Iterator[Config]:
    """Yield the configs to try; rows without storage have what `--fit` considers."""
    method, targets = METHODS[row["method"]]
    model = ModelConfig(
        size=row["size"],
        checkpoint="",
        dtype="bfloat16",
        param_dtype="bfloat16",
        base_dtype=row.get("base", ""),
        remat=row.get("remat", "auto"),
    )
    optim = OptimConfig(batch_size=row["batch"], accumulate=row.get("parts", 1))
    data = DataConfig(source=("recordings",))
    parts = {"model": model, "optim": optim, "data": data}
    config = Config(name="benchmark", scale="", peft=method, targets=targets, **parts)
    if "base" in row:
        yield config
        return
    least = float("inf")
    for candidate, peak in fit.ranked(config):
        least = min(least, peak)
        if peak <= fit.budget(row["limit"]):
            yield candidate
    raise ValueError(f"nothing fits into {row['limit']}: expected {least / GIB:.1f} GiB or more")


def measure(row: dict[str, Any], lock: Path) -> dict[str, Any]:
    """Train for some steps and return a row of the table."""
    for config in run_configs(row):
        step, shapes, found = compile_step(config)
        if "base" in row or found["planned"] * GIB <= fit.budget(row["limit"]):
            break
    _, adapters, frozen = adaptation.split(shapes)
    with lock.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        step.load(random_weights(adapters), random_weights(frozen))
        seconds = best(step, repeats=2) / LOOP
    stats = jax.local_devices()[0].memory_stats() or {}
    used = {name: stats.get(key, 0) / GIB for name, key in STATS.items()}
    return row | found | used | {"ms": 1e3 * seconds, "samples/s": row["batch"] / seconds}


def compile_step(config: Config) -> tuple[Step, Any, dict[str, Any]]:
    """Return the compiled step, the model's shapes, and columns of the table."""
    model, start = config.model, time.perf_counter()
    base, _ = base_model(config, abstract=True)
    backbone = dataclasses.replace(base.config, remat=model.remat)
    found = {
        "base": model.base_dtype or model.param_dtype,
        "remat": model.remat,
        "parts": config.optim.accumulate,
        "expected": preflight.estimate_memory(config, backbone).peak / GIB,
        "evaluating": preflight.sampling_peak(config, backbone) / GIB,
    }
    shapes = preflight.abstract_model(config, backbone)
    step = Step(backbone, config, model=shapes, loop=LOOP)
    planned = sum(planned_bytes(step.compiled).values()) / GIB
    return step, shapes, found | {"planned": planned, "compiled": time.perf_counter() - start}


STATS = {"peak": "peak_bytes_in_use", "allocator": "bytes_limit"}


def whole_run(size: str, folder: Path) -> dict[str, Any]:
    """Write a checkpoint and recordings, then train on them in a process with 12 GB."""
    from benchmarks.data import Noise
    from lorasp_jax.data import cache
    from lorasp_jax.models.checkpoints import native

    jax.config.update("jax_platforms", "cpu")
    backbone = dataclasses.replace(sized("pi0", size), param_dtype="bfloat16")
    graphdef, state = nnx.split(nnx.eval_shape(lambda: backbone.create(nnx.Rngs(0))))
    native.save(folder / "base", nnx.merge(graphdef, random_weights(state, np.asarray)))
    cache.write([Noise(500, 224, 224)], folder / "recordings", lambda *_: None)
    options = {
        "--config": "configs/multitask_pi0.py",
        "--scale": "smoke",
        "--name": f"fit_{os.getpid()}",
        "--fit": "12GB",
        "--method": "lora",
        "--peft.rank": "16",
        "--targets": "openpi",
        "--model.size": size,
        "--model.checkpoint": str(folder / "base"),
        "--model.tokenizer": "",
        "--data.source": str(folder / "recordings"),
        "--data.validation": "1",
        "--control-dt": repr(1 / 30),
        "--optim.batch-size": "32",
        "--evaluation.execute-steps": "1",
    }
    arguments = [text for option in options.items() for text in option]
    command = [sys.executable, "-m", "benchmarks.small_cards", "--train", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    output = done.stdout + done.stderr
    print(output)
    found = re.findall(rf"^{BEFORE}(.*)$", output, re.MULTILINE)
    before = json.loads(found[-1]) if found else {}
    if done.returncode:
        return before | {"error": done.stderr[-800:] or output[-800:]}
    rows = (Path("runs") / options["--name"] / "metrics.jsonl").read_text().splitlines()
    last = json.loads(rows[-1])
    figures = {"peak": "memory/peak_gib", "samples/s": "speed/samples_per_second"}
    return before | {name: last.get(key, 0) for name, key in figures.items()}


BEFORE = "before the first step: "


def train(arguments: list[str]) -> int:
    """Train as `train.py` does, but print the memory [GiB] before the first step."""
    from lorasp_jax.cli import train
    from lorasp_jax.training.program import Program

    call, names = Program.__call__, {"in use": "bytes_in_use", "peak before": "peak_bytes_in_use"}

    def printing(program: Program, state: Any, key: jax.Array, done: int, count: int) -> Any:
        program.compile(state, count).result()
        if done == 0:
            stats = jax.local_devices()[0].memory_stats() or {}
            used = {name: stats.get(key, 0) / GIB for name, key in names.items()}
            print(f"\n{BEFORE}{json.dumps(used)}", flush=True)
        return call(program, state, key, done, count)

    Program.__call__ = printing
    return train.main(arguments)


def work(row: dict[str, Any], results: Path) -> None:
    """Measure a row in this process and append it to the results, with the error if it fails."""
    try:
        if row.get("row") == "context":
            found = {"context": context()}
        elif "row" in row:
            with tempfile.TemporaryDirectory() as folder:
                found = whole_run(row["size"], Path(folder))
        else:
            found = measure(row, results.with_suffix(".lock"))
        found |= {"device": jax.devices()[0].device_kind} if "ms" in found else {}
    except Exception as error:  # such as out of memory, which is a result
        found = {"error": f"{type(error).__name__}: {error}"[:1000]}
    with results.open("a") as file:
        file.write(json.dumps(row | found) + "\n")


def context() -> float:
    """Return the GPU memory [GiB] that a process uses outside of JAX's allocator."""
    before = gpu_bytes("used")
    x = jnp.ones((256, 256), jnp.bfloat16)
    jax.block_until_ready(jax.jit(lambda x: (x @ x, jnp.fft.fft(x.astype(jnp.float32))))(x))
    stats = jax.local_devices()[0].memory_stats() or {}
    held = stats.get("pool_bytes", stats.get("bytes_limit", 0))
    return (gpu_bytes("used") - before - held) / GIB


def gpu_bytes(kind: str) -> float:
    """Return the first GPU's "total" or "used" memory [bytes]; without a GPU, a large number."""
    if not shutil.which("nvidia-smi"):
        return 1e12
    query = ["nvidia-smi", f"--query-gpu=memory.{kind}", "--format=csv,noheader,nounits", "-i", "0"]
    return float(subprocess.run(query, capture_output=True, text=True, check=True).stdout) * 2**20


def start(row: dict[str, Any], options: argparse.Namespace, total: float) -> subprocess.Popen:
    """Start the process of a row, with its share of the GPU."""
    share = (fit.read_size(row["limit"]) - fit.CONTEXT) / total
    environment = os.environ | {"XLA_PYTHON_CLIENT_MEM_FRACTION": f"{share:.4f}"}
    command = [sys.executable, "-m", "benchmarks.small_cards", "--row", json.dumps(row)]
    return subprocess.Popen([*command, "--json", str(options.json)], env=environment)


def read(path: Path) -> list[dict[str, Any]]:
    """Return the rows that have been measured."""
    return [*map(json.loads, path.read_text().splitlines())] if path.exists() else []


def waiting(rows: list[dict[str, Any]], results: Path) -> list[dict[str, Any]]:
    """Return the rows that are not among the results, or failed."""
    done = [row for row in read(results) if "error" not in row]
    return [row for row in rows if not any(row.items() <= each.items() for each in done)]


def run_all(left: list[dict[str, Any]], options: argparse.Namespace) -> None:
    """Run the rows in processes, as many at a time as fit into the GPU's memory together."""
    began, total = time.perf_counter(), gpu_bytes("total")
    running: list[tuple[subprocess.Popen, float]] = []
    while (left or running) and time.perf_counter() - began < options.seconds:
        running = [(process, held) for process, held in running if process.poll() is None]
        alone = left and left[0].get("row") == "context"
        slots = 1 if alone or any(held == 0 for _, held in running) else options.parallel
        if left and len(running) < slots:
            held = fit.read_size(left[0]["limit"])
            if sum(held for _, held in running) + held < 0.96 * total:
                row = left.pop(0)
                running.append((start(row, options, total), 0 if alone else held))
                continue
        time.sleep(0.5)
    for process, _ in running:
        process.kill()


def main() -> None:
    """Run the benchmark from the command line."""
    if sys.argv[1:2] == ["--train"]:
        sys.exit(train(sys.argv[2:]))
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--json", type=Path, required=True, help="file for the results")
    parser.add_argument("--only", nargs="+", help="rows with one of these values, such as LoRA-SP")
    parser.add_argument("--sizes", nargs=2, default=["base", "base_pi05"], help="pi0's and pi0.5's")
    parser.add_argument("--parallel", type=int, default=8, help="processes at a time")
    parser.add_argument("--seconds", type=float, default=1e9, help="stop after this time")
    parser.add_argument("--row", type=json.loads, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.row:
        work(options.row, options.json)
        return
    jax.config.update("jax_platforms", "cpu")  # the GPU is for the processes of the rows
    whole = {"size": options.sizes[1], "limit": "12GB", "row": "whole run"}
    rows = [{"row": "context", "limit": "12GB"}, whole, *table(options.sizes)]
    only = options.only
    rows = [row for row in rows if only is None or any(value in only for value in row.values())]
    run_all(waiting(rows, options.json), options)
    columns = (
        "size method limit batch parts base remat expected evaluating planned peak ms samples/s"
    )
    shown = [
        {name: row.get(name, "") for name in [*columns.split(), "error"]}
        for row in read(options.json)
    ]
    print_table(Console(width=250), [row | {"error": row["error"][:60]} for row in shown])


if __name__ == "__main__":
    main()
