"""A study whose cells only write down that they ran."""

import dataclasses
import os
import signal
import time
from multiprocessing import util
from pathlib import Path

from lorasp_jax.config import Config, OptimConfig
from lorasp_jax.extras.study import Cell, Derived, Study, progress
from lorasp_jax.extras.study import results as files
from lorasp_jax.peft import LoRA, LoRASP
from lorasp_jax.training.run_folder import to_json, write_json

CONFIG = Config(name="cell", scale="smoke", peft=LoRASP(rank=8), tasks=("press", "pour"))
NAMES = ("sp/s0", "sp/s1", "lora/s0", "lora/s1", "lr", "cut/s0")


def same_rank(results):
    """LoRA whose rank is the mean active rank of two cells."""
    ranks = [results[name]["active_rank"]["mean"] for name in ("sp/s0", "sp/s1")]
    return dataclasses.replace(CONFIG, peft=LoRA(rank=round(sum(ranks) / 2)))


def study(**changes) -> Study:
    """Six cells; `changes` replace the config of cells by name."""
    configs = {
        "sp/s0": CONFIG,
        "sp/s1": dataclasses.replace(CONFIG, seed=1),
        "lora/s0": same_rank,
        "lora/s1": lambda results: dataclasses.replace(same_rank(results), seed=1),
        "lr": dataclasses.replace(CONFIG, optim=OptimConfig(steps=7)),
    }
    both = ("sp/s0", "sp/s1")
    cells = [
        Cell(name, config, both if name.startswith("lora") else (), name.partition("/")[0])
        for name, config in (configs | changes).items()
    ]
    return Study("fake", (*cells, Derived("cut/s0", "lora/s0", lambda p, r, e: p, ("sp/s0",))))


def run(job) -> dict:
    """Note the cell's name in runs.txt, and make up its results."""
    with (job.study_folder / "runs.txt").open("a") as file:
        file.write(f"{job.cell.name}\n")
    seed = sum(job.cell.name.encode())
    return {
        "outcomes": {task: f"{seed % 2**16:016b}" for task in job.config.tasks},
        "active_rank": {"action": 3.0, "mean": 3 + seed % 2},
        "layer_active_rank": {"action": {"q_proj": [seed / 7]}},
        "active_rank_histogram": {"action": [1, 2, 3]},
        "trainable_parameters": 10,
        "total_parameters": 100,
        "seconds": {"total": 1.0 + seed % 3},
        "speed": {"samples_per_second": 123.456789},
        "measures": {"needs": sorted(job.results)},
    }


def run_slowly(job) -> dict:
    """Like `run`, but give others time to interfere."""
    time.sleep(0.02)
    return run(job)


def run_or_die(job) -> dict:
    """Like `run`, but be killed in one cell and raise an exception in another."""
    if job.cell.name == "lr":
        raise RuntimeError("boom\nbang")
    if job.cell.name == "sp/s1":
        os.kill(os.getpid(), signal.SIGKILL)
    return run(job)


def run_beside_another(job) -> dict:
    """Like `run`, but be killed in one cell while another worker, too, has died in it."""
    if job.cell.name == "lr":
        progress.record_failure(job.folder, "the worker stopped by SIGKILL", "")
        os.kill(os.getpid(), signal.SIGKILL)
    return run(job)


def run_and_die_late(job) -> dict:
    """Like `run`, but be killed when there is nothing left to run."""
    util.Finalize(None, os.kill, (os.getpid(), signal.SIGKILL), exitpriority=1)
    return run(job)


def many() -> Study:
    """Twelve cells that any worker may run."""
    return Study("many", tuple(Cell(f"c{i}", CONFIG) for i in range(12)))


def run_with_three_others(job) -> dict:
    """Like `run`, but only once four workers have cells; be killed in one of them."""
    pids = job.study_folder / "pids"
    pids.mkdir(exist_ok=True)
    (pids / str(os.getpid())).touch()
    deadline = time.monotonic() + 120
    while len([*pids.iterdir()]) < 4:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    if job.cell.name == "c2":
        os.kill(os.getpid(), signal.SIGKILL)
    return run(job)


def ran(folder: Path) -> list[str]:
    """Names of the cells in the order in which they ran."""
    return (folder / "runs.txt").read_text().split() if (folder / "runs.txt").exists() else []


def states(folder: Path, of: Study | None = None) -> dict[str, str]:
    statuses = progress.read(of or study(), folder)
    return {name: str(status.state) for name, status in statuses.items()}


def results(folder: Path) -> dict:
    statuses = progress.read(study(), folder)
    return progress.results_of(statuses, statuses)


def begin(folder: Path, config: Config) -> None:
    """Write the config of a run that has started."""
    folder.mkdir(parents=True)
    write_json(folder / "config.json", to_json(config))


def run_and_interrupt(job) -> dict:
    """Be stopped by SIGTERM in the first cell."""
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(10)
    return run(job)


def no_study() -> Study:
    raise ValueError("no study today")


def failing(name):
    """Return a function that runs all cells but one."""

    def run_others(job):
        if job.cell.name == name:
            raise RuntimeError("boom")
        return run(job)

    return run_others


def without(file, *names):
    """Remove cells from a file of files."""
    found = files.load(file)
    files.write(file, "fake", {n: r for n, r in found.items() if n not in names})
