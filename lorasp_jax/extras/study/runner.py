"""Run the cells of a study: one worker, of which many may share a study's folder.

A worker claims a cell with a lock, which the operating system releases even if the worker is
killed. What is finished stands in the cells' folders, so that workers need not talk to each other,
and a killed one loses at most the steps since its last checkpoint.
"""

import contextlib
import functools
import itertools
import time
import traceback
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import filelock

from lorasp_jax.base.errors import describe_any
from lorasp_jax.base.locks import acquire
from lorasp_jax.config import Config
from lorasp_jax.extras.study import progress
from lorasp_jax.extras.study.progress import CellState
from lorasp_jax.extras.study.study import Cell, Derived, Measure, Results, Study
from lorasp_jax.training.run_folder import write_json

POLL = 5.0
"""Time between two looks at the cells of other workers [s]."""


@dataclass(frozen=True)
class Job:
    """A cell that can run.

    Attributes:
        cell: the cell.
        config: config of its run.
        study_folder: the study's folder.
        results: results of the cells that it needs.
        measure: measures its policy further, if given.
    """

    cell: Cell | Derived
    config: Config
    study_folder: Path
    results: Results
    measure: Measure | None = None

    @property
    def folder(self) -> Path:
        """The cell's folder."""
        return self.study_folder / self.cell.name


RunCell = Callable[[Job], dict[str, Any]]
"""Runs a cell, resuming it if it was interrupted; returns cell.json without the config."""
Say = Callable[[str], None]
"""Called with a line of text when a cell begins and when it has ended."""


def work(
    study: Study,
    folder: Path,
    names: Collection[str],
    run_cell: RunCell,
    say: Say = print,
) -> None:
    """Run the named cells, in the study's order, until none of them can run.

    Each worker begins with a group of its own, whose programs no other compiles, and goes on with
    the others of its group; it helps with theirs when no group is left. While another worker runs
    a cell, this one waits: the cell may enable others, or be left behind.
    """
    group_of = {cell.name: group for group, cells in study.groups.items() for cell in cells}
    last = ""
    with contextlib.closing(_Group(folder)) as own:
        while True:
            statuses = progress.read(study, folder)
            runnable = [
                cell.name
                for cell in study.cells
                if cell.name in names and statuses[cell.name].state is CellState.RUNNABLE
            ]
            if not runnable:
                return
            run = functools.partial(_run_claimed, study, folder, run_cell, say, set())
            shared = sorted(runnable, key=lambda name: group_of[name] != group_of.get(last))
            tried = itertools.chain(own.cells(runnable, group_of), shared)
            # The best cell that is free; then look again: it may have enabled better ones.
            ran = next((name for name in tried if run(name)), "")
            if not ran:
                time.sleep(POLL)
            last = ran or last


class _Group:
    """The group that a worker claims for itself, "" at first."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._name, self._claim = folder, "", contextlib.ExitStack()

    def cells(self, runnable: Iterable[str], group_of: Mapping[str, str]) -> Iterator[str]:
        """Yield the runnable cells of this group, then claim others in turn and yield theirs."""
        found: dict[str, list[str]] = {}
        for name in runnable:
            found.setdefault(group_of[name], []).append(name)
        for group in sorted(found, key=lambda group: group != self._name):
            if group == self._name or self._claimed(group):
                yield from found[group]

    def _claimed(self, group: str) -> bool:
        """Claim a group instead of this one; return False if another worker has it."""
        claim = contextlib.ExitStack()
        if not claim.enter_context(_claimed(self._folder, f".groups/{group}")):
            return False
        self.close()
        self._name, self._claim = group, claim
        return True

    def close(self) -> None:
        """Leave the group to others."""
        self._claim.close()


def _run_claimed(
    study: Study, folder: Path, run_cell: RunCell, say: Say, taken: set[str], name: str
) -> bool:
    """Run a cell, after those of `_due`; return False if another worker has claimed one of them.

    Those are added to `taken`, and not tried again: a source that is released between two of the
    cells that need it must not let the second one run before the first.
    """
    for due in _due(study, folder, study[name]):
        if due.name in taken:
            return False
        with _claimed(folder, due.name) as claimed:
            if not claimed:
                taken.add(due.name)
                return False
            statuses = progress.read(study, folder)
            config = statuses[due.name].config
            if due.name == name:
                is_due = statuses[name].state is CellState.RUNNABLE
            else:
                is_due = not _is_here(folder, due.name)
            if is_due and config:  # no other worker has run the cell meanwhile
                results = progress.results_of(due.needs, statuses)
                measure = study.measure if due.measured else None
                run_one(Job(due, config, folder, results, measure), run_cell, say)
    return True


def _due(study: Study, folder: Path, cell: Cell | Derived) -> list[Cell | Derived]:
    """Return a cell, after the sources that must run again because their folders are not here.

    That is so if the study started from a file of results.
    """
    source = cell.source
    if not source or isinstance(source, Path) or _is_here(folder, source):
        return [cell]
    return [*_due(study, folder, study[source]), cell]


def _is_here(folder: Path, name: str) -> bool:
    """Say whether a cell has run in this folder, so that its policy is here."""
    return (folder / name / progress.CELL_FILE).exists()


def run_one(job: Job, run_cell: RunCell, say: Say) -> None:
    """Run a cell and write cell.json, or failed.txt if it raises an exception."""
    say(f"running {job.cell.name}")
    try:
        job.folder.mkdir(parents=True, exist_ok=True)
        result = run_cell(job)
        settings = progress.describe_config(job.cell, job.config)
        write_json(job.folder / progress.CELL_FILE, {"config": settings, **result})
    except Exception as error:
        progress.record_failure(job.folder, describe_any(error), traceback.format_exc())
        say(f"{job.cell.name}: failed: {describe_any(error)}")
    else:
        progress.tidy(job.folder)
        say(_summary(job.cell.name, result))


def _summary(name: str, result: dict[str, Any]) -> str:
    """Return the success of a cell by task, on one line."""
    outcomes = result["outcomes"].items()
    rates = (f"{task} {text.count('1') / len(text):.1%}" for task, text in outcomes)
    return f"{name}: {', '.join(rates)} in {result['seconds']['total']:.0f} s"


@contextlib.contextmanager
def _claimed(folder: Path, name: str) -> Iterator[bool]:
    """Claim a cell in this block; yield False if another worker has it."""
    file = folder / "locks" / f"{name}.lock"
    file.parent.mkdir(parents=True, exist_ok=True)
    try:
        lock = acquire(file)
    except filelock.Timeout:
        yield False
        return
    with lock:
        yield True
