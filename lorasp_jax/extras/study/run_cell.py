"""Run one cell of a study: train and evaluate, or derive a policy and evaluate it."""

import contextlib
import dataclasses
import functools
import gc
import hashlib
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from envs.datasets.episodes import Episodes
from lorasp_jax.base import compilation_cache as cache
from lorasp_jax.base.locks import locked
from lorasp_jax.config import Config
from lorasp_jax.evaluation import metrics
from lorasp_jax.evaluation.callback import Evaluation
from lorasp_jax.extras.study import held_out
from lorasp_jax.extras.study.cost import training_cost
from lorasp_jax.extras.study.measures import measures
from lorasp_jax.extras.study.runner import Job
from lorasp_jax.extras.study.study import Cell, Derived
from lorasp_jax.training import loop, records, setup
from lorasp_jax.training.base import base_model
from lorasp_jax.training.demonstrations import Progress, demonstrations, map_threads
from lorasp_jax.training.export import Export, load_policy
from lorasp_jax.training.run import Run
from lorasp_jax.training.run_folder import open_run, read_json

WIDTH = 120
"""Line length of logs."""


def run_cell(job: Job) -> dict[str, Any]:
    """Run a cell and return what cell.json records about it, except the settings.

    Raises:
        ValueError: see `setup.prepare` and `loop.train`; for a derived cell, the source's policy is
            missing or cannot be transformed; the device computed some episodes wrongly.
    """
    cache.enable()
    try:
        return _derive(job) if isinstance(job.cell, Derived) else _train(job)
    finally:
        gc.collect()  # models have reference cycles; the next cell needs their memory


def _train(job: Job) -> dict[str, Any]:
    """Train a policy, or resume it, and evaluate it."""
    assert isinstance(job.cell, Cell)
    console, started = Console(width=WIDTH), time.perf_counter()
    collect = functools.partial(shared_demonstrations, job.study_folder)
    with open_run(job.config, job.folder.parent, resume="auto"):
        run = setup.prepare(job.config, job.folder, console, started, collect=collect)
        loop.train(run, [Export(), Evaluation(write_video=None)], resume=True)
        found: dict[str, Any] = {"speed": {}, "measures": {}}
        if job.cell.measured:
            with run.timed("measure"):
                found = _measure(job, run)
        return {**_results(run), **found}


def _measure(job: Job, run: Run) -> dict[str, Any]:
    """Return the costs of training, and the measures on held-out demonstrations."""
    base = base_model(job.config)[0] if job.config.peft.trains_base else None
    episodes = held_out_demonstrations(job.study_folder, run.config)
    return {
        "speed": training_cost(job.folder, job.config, run.policy.model.config),
        "measures": measures(run.policy, episodes, base=base),
    }


def _derive(job: Job) -> dict[str, Any]:
    """Transform the policy of another cell and evaluate it."""
    assert isinstance(job.cell, Derived)
    run = Run(job.config, job.folder, Console(width=WIDTH), "")
    with run.timed("derive"):
        source = load_policy(job.study_folder / job.cell.source)
        run.episodes = held_out_demonstrations(job.study_folder, run.config)
        run.policy = job.cell.transform(source, job.results, run.episodes)
    Evaluation(write_video=None).on_end(run)
    with run.timed("measure"):
        measured = measures(run.policy, run.episodes, source=source)
    return {**_results(run), "speed": {}, "measures": measured}


def _results(run: Run) -> dict[str, Any]:
    """Return what cell.json takes from results.json.

    Raises:
        ValueError: the device computed some episodes wrongly.
    """
    results = read_json(run.folder / "results.json", records.RESULTS)
    tasks: Mapping[str, Any] = results["tasks"]
    outcomes = {task: value["after"]["outcomes"] for task, value in tasks.items()}
    before = {t: value["before"]["outcomes"] for t, value in tasks.items() if "before" in value}
    if bias := metrics.position_bias([o == "1" for o in text] for text in outcomes.values()):
        raise ValueError(bias)
    names = (
        "active_rank",
        "layer_active_rank",
        "active_rank_histogram",
        "trainable_parameters",
        "total_parameters",
    )
    return {
        "outcomes": outcomes,
        **({"before": before} if before else {}),
        **{name: results[name] for name in names},
        "seconds": dict(run.seconds),
    }


def shared_demonstrations(
    study_folder: Path, config: Config, _folder: Path, progress: Progress
) -> dict[str, Episodes]:
    """Load the demonstrations that cells with the same robot, scene and data settings share.

    They do not depend on the seed, and a task has the same ones whatever tasks it is trained with.
    The first cell that needs them collects them.
    """
    shared = dataclasses.replace(config, seed=0)
    return _shared(study_folder / "demonstrations", shared, progress)


def held_out_demonstrations(study_folder: Path, config: Config) -> dict[str, Episodes]:
    """Load the held-out demonstrations (see `held_out.settings`), shared in the same way."""
    return _shared(study_folder / "held_out", held_out.settings(config))


def _shared(
    root: Path, config: Config, progress: Progress = lambda *_: None
) -> dict[str, Episodes]:
    """Load each task's episodes from a folder named after the settings, or collect them there."""
    settings = {
        "robot": config.robot,
        "data": dataclasses.asdict(config.data),
        "image_size": config.image_size,
        "control_dt": config.control_dt,
    }
    if ranges := config.scene.changed():
        settings["scene"] = ranges
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]
    folder = root / f"{Path(config.robot).stem}_{digest}"

    def one(task: str) -> Episodes:
        single = dataclasses.replace(config, tasks=(task,))
        with _alone(folder / "cache" / f"{task}.npz"):
            return demonstrations(single, folder, progress)[task]

    return dict(zip(config.tasks, map_threads(one, config.tasks), strict=True))


def _alone(file: Path) -> contextlib.AbstractContextManager[None]:
    """Let one process at a time make a file; nobody waits once it exists."""
    return contextlib.nullcontext() if file.exists() else locked(file, waiting=lambda: None)
