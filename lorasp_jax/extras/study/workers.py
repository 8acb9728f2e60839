"""Run a study in several processes on one device, or a small one in this process."""

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Collection, Iterator
from multiprocessing import connection
from pathlib import Path
from typing import Any

from lorasp_jax.base.errors import INTERRUPTED
from lorasp_jax.base.processes import end_with_parent
from lorasp_jax.extras.study import progress, results
from lorasp_jax.extras.study.progress import CellState
from lorasp_jax.extras.study.runner import Job, RunCell, Say, work
from lorasp_jax.extras.study.study import Study
from lorasp_jax.training.interrupt import sigterm_as_interrupt

_SPAWN = multiprocessing.get_context("spawn")  # JAX must not be forked
_LONGEST_NAME = 4096


def _run_cell(job: Job) -> dict[str, Any]:
    """Run a cell; the import is here because the parent process needs no model code."""
    from lorasp_jax.extras.study import run_cell

    return run_cell.run_cell(job)


def run_workers(
    load: Callable[[], Study],
    folder: Path,
    names: Collection[str],
    count: int,
    run_cell: RunCell = _run_cell,
) -> None:
    """Run the named cells in `count` processes, until none of them can run.

    A worker that is killed in a cell fails this cell and is replaced.

    Args:
        load: loads the study; like `run_cell`, each worker gets a pickled copy.
        folder: the study's folder.
        names: cells to run.
        count: number of processes.
        run_cell: runs one cell.

    Raises:
        ValueError: a worker died outside of a cell.
        KeyboardInterrupt: a signal arrived; the workers were told to save and stop.
    """
    arguments = load, folder, frozenset(names), run_cell
    workers = [_Worker(arguments) for _ in range(count)]
    try:
        with sigterm_as_interrupt():
            while workers:
                connection.wait([worker.process.sentinel for worker in workers])
                for worker in [each for each in workers if not each.process.is_alive()]:
                    workers.remove(worker)
                    if worker.process.exitcode:
                        worker.fail_cell(folder)
                        workers.append(_Worker(arguments))
    except KeyboardInterrupt:
        print("stopping: running cells save their state first; another signal ends them")
        for worker in workers:
            worker.process.terminate()
        for worker in workers:
            worker.process.join()
        raise
    finally:
        for worker in workers:
            worker.process.kill()


class _Worker:
    """A process that runs cells, and the name of the cell that it runs, "" between cells."""

    def __init__(self, arguments: tuple[Any, ...]) -> None:
        self.cell = _SPAWN.RawArray(ctypes.c_char, _LONGEST_NAME)
        self.process = _SPAWN.Process(target=_work, args=(self.cell, *arguments))
        self.process.start()

    def fail_cell(self, folder: Path) -> None:
        """Record that the process has died in a cell; for errors see `run_workers`.

        Another worker may have claimed the cell since and have ended it.
        """
        code, name = self.process.exitcode or 0, self.cell.value.decode()
        if code == INTERRUPTED:
            raise KeyboardInterrupt
        how = f"with exit code {code}" if code >= 0 else f"by {signal.Signals(-code).name}"
        if not name:
            raise ValueError(f"a worker stopped {how} outside of a cell")
        if progress.has_ended(folder / name):
            return
        progress.record_failure(folder / name, f"the worker stopped {how}", "")
        print(f"{name}: failed: the worker stopped {how}", flush=True)


def _work(
    cell: Any,
    load: Callable[[], Study],
    folder: Path,
    names: Collection[str],
    run_cell: RunCell,
) -> None:
    """Run cells in a process of its own, which ends with its parent."""
    os.setpgid(0, 0)  # Ctrl-C reaches only the parent, which then sends SIGTERM
    end_with_parent()

    def run(job: Job) -> dict[str, Any]:
        cell.value = job.cell.name.encode()
        with _output_to(folder / "logs" / f"{job.cell.name}.txt"):
            return run_cell(job)

    def say(text: str) -> None:  # when a cell has ended, and before the next one
        cell.value = b""
        print(text, flush=True)

    try:
        with sigterm_as_interrupt():
            work(load(), folder, names, run, say)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def _to_stderr(text: str) -> None:
    print(text, file=sys.stderr)


def run_here(
    study: Study,
    folder: Path,
    names: Collection[str],
    say: Say = _to_stderr,
    run_cell: RunCell = _run_cell,
) -> dict[str, dict[str, Any]]:
    """Run some cells in this process; write and return the results of all that are finished.

    What the cells print goes to files. Results of cells that an earlier command had stay.

    Raises:
        ValueError: one of the cells failed, or has run with other settings.
    """

    def run(job: Job) -> dict[str, Any]:
        with _output_to(folder / "logs" / f"{job.cell.name}.txt"):
            return run_cell(job)

    folder.mkdir(exist_ok=True)
    for name in names:
        progress.clear_failure(folder / name)
    work(study, folder, names, run, say)
    statuses = progress.read(study, folder)
    for name in names:
        if statuses[name].state is not CellState.FINISHED:
            raise ValueError(f"{folder / name}: {statuses[name].state} {statuses[name].reason}")
    found, file = progress.results_of(statuses, statuses), folder / results.RESULTS_FILE
    earlier = results.load(file, study.name) if file.exists() else {}
    others = {name: result for name, result in earlier.items() if name not in statuses}
    results.write(file, study.name, {**others, **found})
    return found


@contextlib.contextmanager
def _output_to(file: Path) -> Iterator[None]:
    """Append to a file what this process prints in this block, also from C++."""
    file.parent.mkdir(parents=True, exist_ok=True)
    saved = os.dup(1), os.dup(2)
    try:
        with file.open("a") as log:
            sys.stdout.flush()
            for number in (1, 2):
                os.dup2(log.fileno(), number)
        yield
    finally:
        sys.stdout.flush()
        for number, original in zip((1, 2), saved, strict=True):
            os.dup2(original, number)
            os.close(original)
