"""Run the cells of a study: one worker, of which many may share a study's folder.

A worker claims a whole group of cells with a lock, which the operating system releases even if the
worker is killed. What is finished stands in the cells' folders, so that workers need not talk to
each other, and a killed one loses at most the steps since its last checkpoint.
"""

import contextlib
import functools
import time
import traceback
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import filelock

from envs.datasets.locks import acquire
from lorasp_jax.config import Config
from lorasp_jax.study import status
from lorasp_jax.study.status import Board, State
from lorasp_jax.study.study import Cell, Derived, Results, Study
from lorasp_jax.training.run_folder import write_json

POLL = 2.0
"""Time between two looks at the cells of other workers [s]."""


@dataclass(frozen=True)
class Job:
    """A cell that can run.

    Attributes:
        cell: the cell.
        config: config of its run; that of the source's run for a derived cell.
        study_folder: the study's folder.
        results: results of the cells that it needs.
    """

    cell: Cell | Derived
    config: Config
    study_folder: Path
    results: Results

    @property
    def folder(self) -> Path:
        """The cell's folder."""
        return self.study_folder / self.cell.name


RunCell = Callable[[Job], dict[str, Any]]
"""Runs a cell, resuming it if it was interrupted; returns cell.json without the config."""
Report = Callable[[str, str], None]
"""Called with "start", "end" or "fail" and the name of a cell."""


def work(
    study: Study,
    folder: Path,
    names: Collection[str],
    run_cell: RunCell,
    report: Report = lambda _event, _name: None,
    poll: float = POLL,
) -> None:
    """Run the named cells until none of them can run.

    While another worker runs one, this one waits: the cell may enable others, or be left behind.
    """
    board = Board(study, folder)
    while True:
        statuses = board.read()
        groups = {
            group: [cell for cell in cells if cell.name in names]
            for group, cells in study.groups.items()
            if any(c.name in names and statuses[c.name].state is State.RUNNABLE for c in cells)
        }
        if not groups:
            return
        # The first group that is free; then look again, because it may have enabled earlier ones.
        run_group = functools.partial(_run_group, study, board, folder, run_cell, report)
        if not any(run_group(*item) for item in groups.items()):
            time.sleep(poll)


def _run_group(
    study: Study,
    board: Board,
    folder: Path,
    run_cell: RunCell,
    report: Report,
    group: str,
    cells: list[Cell | Derived],
) -> bool:
    """Run what can run in a group; return False if another worker has claimed the group."""
    with _claimed(folder, group) as claimed:
        for cell in cells if claimed else ():
            for due in _due(study, folder, cell):
                statuses = board.read()  # another worker may have run the cell meanwhile
                if statuses[cell.name].state is State.RUNNABLE:
                    config = statuses[due.name].config
                    assert config is not None
                    results = status.results_of(due.needs, statuses)
                    run_one(Job(due, config, folder, results), run_cell, report)
        return claimed


def _due(study: Study, folder: Path, cell: Cell | Derived) -> list[Cell | Derived]:
    """Return a cell, after the sources that must run again because no policy of theirs is here.

    That is so if the study started from a file of results.
    """
    if not isinstance(cell, Derived) or (folder / cell.source / status.CELL_FILE).exists():
        return [cell]
    return [*_due(study, folder, study[cell.source]), cell]


def run_one(job: Job, run_cell: RunCell, report: Report) -> None:
    """Run a cell and write cell.json, or failed.txt if it raises an exception."""
    report("start", job.cell.name)
    try:
        job.folder.mkdir(parents=True, exist_ok=True)
        result = run_cell(job)
        settings = status.describe_config(job.cell, job.config)
        write_json(job.folder / status.CELL_FILE, {"config": settings, **result})
    except Exception as error:
        status.record_failure(job.folder, status.one_line(error), traceback.format_exc())
        report("fail", job.cell.name)
    else:
        status.tidy(job.folder)
        report("end", job.cell.name)


@contextlib.contextmanager
def _claimed(folder: Path, group: str) -> Iterator[bool]:
    """Claim a group in this block; yield False if another worker has it."""
    file = folder / "groups" / f"{group}.lock"
    file.parent.mkdir(parents=True, exist_ok=True)
    try:
        lock = acquire(file)
    except filelock.Timeout:
        yield False
        return
    with lock:
        yield True
