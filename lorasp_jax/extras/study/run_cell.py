"""Run one cell of a study: train or derive a policy, and evaluate it."""

import functools
import gc
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

import lorasp_jax
from lorasp_jax.base import compilation_cache as cache
from lorasp_jax.evaluation import metrics
from lorasp_jax.evaluation.callback import Evaluation
from lorasp_jax.extras.study import progress
from lorasp_jax.extras.study.held_out import held_out_demonstrations, shared_demonstrations
from lorasp_jax.extras.study.provenance import provenance
from lorasp_jax.extras.study.runner import Job
from lorasp_jax.extras.study.study import Cell, Derived
from lorasp_jax.training import loop, records, setup
from lorasp_jax.training.export import Export, load_policy
from lorasp_jax.training.run import Run
from lorasp_jax.training.run_folder import changed_settings, open_run, read_json, write_json

WIDTH = 120
"""Line length of logs."""
_source = functools.lru_cache(maxsize=1)(load_policy)
"""The policy that the last derived cell started from; most start from the same one."""

_programs: dict[Any, Any] = {}
"""Traced training programs of this process, which the cells of a group share."""


def run_cell(job: Job) -> dict[str, Any]:
    """Run a cell and return what cell.json records about it, except the settings.

    Raises:
        ValueError: see `setup.prepare` and `loop.train`; for a derived cell, the source's policy is
            missing or cannot be transformed; the device computed some episodes wrongly.
    """
    cache.enable()
    provenance()  # of the code that runs, which may change on the disk meanwhile
    try:
        return _derive(job) if isinstance(job.cell, Derived) else _train(job)
    finally:
        gc.collect()  # models have reference cycles; the next cell needs their memory


def _train(job: Job) -> dict[str, Any]:
    """Train a policy, or resume it, and evaluate it."""
    assert isinstance(job.cell, Cell)
    _source.cache_clear()
    console, started = Console(width=WIDTH), time.perf_counter()
    collect = functools.partial(shared_demonstrations, job.study_folder, job.cell.pool)
    callbacks = [Export()] if job.cell.evaluate else [Export(), Evaluation(media=False)]
    callbacks = [] if (found := _evaluated(job)) else callbacks
    with open_run(job.config, job.folder.parent, resume="auto"):
        run = setup.prepare(job.config, job.folder, console, started, collect=collect)
        run.programs = _programs
        loop.train(run, callbacks, resume=True)
        return _finish(job, run, None, found)


def _derive(job: Job) -> dict[str, Any]:
    """Transform the policy of another cell or run, and evaluate it."""
    assert isinstance(job.cell, Derived)
    run = Run(job.config, job.folder, Console(width=WIDTH), "")
    with run.timed("derive"):
        where = job.cell.source
        source = _source(where if isinstance(where, Path) else job.study_folder / where)
        run.policy = source
        if job.cell.transform:
            episodes = held_out_demonstrations(job.study_folder, job.config)
            run.policy = job.cell.transform(source, job.results, episodes)
    if not ((found := _evaluated(job)) or job.cell.evaluate):
        Evaluation(media=False).on_end(run)
    return _finish(job, run, source, found)


def _finish(
    job: Job, run: Run, source: lorasp_jax.policies.Policy | None, found: dict[str, Any]
) -> dict[str, Any]:
    """Return what cell.json records about a run, whose policy simulation may have evaluated.

    `found` was evaluated before, if anything; see `_evaluated`.
    """
    if not found:
        with run.timed("evaluate"):
            found = (job.cell.evaluate or simulated)(run) | {"provenance": provenance()}
        settings = progress.describe_config(job.cell, job.config)
        write_json(job.folder / progress.EVALUATED_FILE, {"config": settings, **found})
    if job.measure:
        with run.timed("measure"):
            episodes = held_out_demonstrations(job.study_folder, run.config)
            found |= job.measure(run, episodes, source)
    return {**found, "seconds": dict(run.seconds)}


def _evaluated(job: Job) -> dict[str, Any]:
    """Return what was evaluated before the process was killed in `measure`; else {}."""
    found = read_json(job.folder / progress.EVALUATED_FILE, progress.SCHEMA)
    settings = progress.describe_config(job.cell, job.config)
    same = found and not changed_settings(found.pop("config"), settings)
    same = same and found["provenance"]["code"] == provenance()["code"]
    return found if same else {}


def simulated(run: Run) -> dict[str, Any]:
    """Return what cell.json takes from results.json.

    Raises:
        ValueError: the device computed some episodes wrongly.
    """
    results = read_json(run.folder / "results.json", records.RESULTS)
    tasks: Mapping[str, Any] = results["tasks"]
    outcomes = {task: value["after"]["outcomes"] for task, value in tasks.items()}
    if bias := metrics.position_bias([o == "1" for o in text] for text in outcomes.values()):
        raise ValueError(bias)
    before = {t: value["before"]["outcomes"] for t, value in tasks.items() if "before" in value}
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
    }
