"""Run a study in several processes on one device, with one progress bar over all cells."""

import contextlib
import functools
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Collection, Iterator
from multiprocessing import connection, context
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from lorasp_jax.base.errors import INTERRUPTED
from lorasp_jax.extras.study import progress, results
from lorasp_jax.extras.study.progress import CellState, Status
from lorasp_jax.extras.study.runner import Job, RunCell, work
from lorasp_jax.extras.study.study import Study
from lorasp_jax.training.interrupt import sigterm_as_interrupt

_SPAWN = multiprocessing.get_context("spawn")  # JAX must not be forked


def _run_cell(job: Job) -> dict[str, Any]:
    """Run a cell; the import is here because the parent process needs no model code."""
    from lorasp_jax.extras.study import run_cell

    return run_cell.run_cell(job)


class Workers:
    """Processes that run the named cells, and the progress bar that shows them.

    Each worker sends ("start" | "end" | "fail", cell) over its pipe. A worker that dies in a cell
    fails this cell and is replaced.
    """

    def __init__(
        self,
        load: Callable[[], Study],
        folder: Path,
        names: Collection[str],
        console: Console,
        run_cell: RunCell = _run_cell,
    ) -> None:
        """Start nothing yet.

        Args:
            load: loads the study; like `run_cell`, each worker gets a pickled copy.
            folder: the study's folder.
            names: cells to run.
            console: for the progress bar.
            run_cell: runs one cell.
        """
        self._arguments = load, folder, frozenset(names), run_cell
        self._study, self._folder, self._names = load(), folder, names
        self._console = console
        self._running: dict[context.SpawnProcess, tuple[connection.Connection, list[str]]] = {}

    def run(self, count: int) -> None:
        """Run `count` workers until they have nothing left to do.

        Raises:
            ValueError: a worker died outside a cell.
            KeyboardInterrupt: a signal arrived; the workers were told to save and stop.
        """
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
        for _ in range(count):
            self._start()
        with self._stopping(), Progress(*columns, console=self._console) as shown:
            bar = shown.add_task("cells", total=len(self._names))
            while self._running:
                statuses = progress.read(self._study, self._folder)
                done = [n for n in self._names if statuses[n].state is CellState.FINISHED]
                now = [name for _, cells in self._running.values() for name in cells]
                shown.update(bar, completed=len(done), description=", ".join(now) or "cells")
                pipes = {pipe: worker for worker, (pipe, _) in self._running.items()}
                for pipe in connection.wait(list(pipes)):
                    assert isinstance(pipe, connection.Connection)
                    self._receive(pipes[pipe], pipe)

    def _start(self) -> None:
        """Start a worker."""
        pipe, worker_pipe = _SPAWN.Pipe()
        worker = _SPAWN.Process(target=_worker, args=(worker_pipe, *self._arguments))
        worker.start()
        worker_pipe.close()
        self._running[worker] = pipe, []

    def _receive(self, worker: context.SpawnProcess, pipe: connection.Connection) -> None:
        """Handle one message of a worker, or its end."""
        cells = self._running[worker][1]
        try:
            event, name = pipe.recv()
        except EOFError:
            worker.join()
            del self._running[worker]
            self._handle_exit(worker.exitcode, cells)
            return
        if event == "start":
            cells.append(name)
            return
        cells.remove(name)
        self._print(name)

    def _handle_exit(self, code: int | None, cells: list[str]) -> None:
        """After a worker died, fail the cell that it ran and start another worker."""
        if code == INTERRUPTED:
            raise KeyboardInterrupt
        if code and not cells:
            raise ValueError(f"a worker stopped {_how(code)} outside of a cell")
        for name in cells:
            reason = f"the worker stopped {_how(code or 0)}"
            progress.record_failure(self._folder / name, reason, "")
            self._print(name)
            self._start()

    def _print(self, name: str) -> None:
        """Print on one line how a cell ended."""
        text, style = line(name, progress.read(self._study, self._folder)[name])
        self._console.print(text, style=style, highlight=False, markup=False, soft_wrap=True)

    @contextlib.contextmanager
    def _stopping(self) -> Iterator[None]:
        """Stop the workers at the end of the block, which a signal ends with KeyboardInterrupt."""
        try:
            with sigterm_as_interrupt():
                yield
        except KeyboardInterrupt:
            self._console.print(
                "stopping: running cells save their state first; another signal ends them"
            )
            for worker in self._running:
                worker.terminate()
            for worker in self._running:
                worker.join()
            raise
        finally:
            for worker in self._running:
                worker.kill()


def line(name: str, status: Status) -> tuple[str, str | None]:
    """Return how a cell ended, on one line, and the line's style."""
    if not status.result:
        style = "red" if status.state in progress.BROKEN else None
        return f"{name}: {status.state} {status.reason}", style
    rates = [
        f"{task} {outcomes.count('1') / len(outcomes):.1%}"
        for task, outcomes in status.result["outcomes"].items()
    ]
    seconds = status.result["seconds"]["total"]
    return f"{name}: {', '.join(rates)} in {seconds:.0f} s", None


def run_here(
    study: Study,
    folder: Path,
    names: Collection[str],
    console: Console,
    run_cell: RunCell = _run_cell,
) -> dict[str, dict[str, Any]]:
    """Run some cells in this process; write and return the results of all that are finished.

    What the cells print goes to files.

    Raises:
        ValueError: one of the cells failed, or has run with other settings.
    """
    folder.mkdir(exist_ok=True)
    for name in names:
        progress.clear_failure(folder / name)

    def report(event: str, name: str) -> None:
        if event == "start":
            console.print(f"measuring {name}", highlight=False)

    work(study, folder, names, functools.partial(_logged, folder, run_cell), report)
    statuses = progress.read(study, folder)
    found = progress.results_of(statuses, statuses)
    results.write(folder / results.RESULTS_FILE, study.name, found)
    for name in names:
        if statuses[name].state is not CellState.FINISHED:
            raise ValueError(f"{folder / name}: {statuses[name].state} {statuses[name].reason}")
    return found


def _logged(folder: Path, run_cell: RunCell, job: Job) -> dict[str, Any]:
    """Run a cell; append what it prints to a file."""
    with _output_to(folder / "logs" / f"{job.cell.name}.txt"):
        return run_cell(job)


def _how(code: int) -> str:
    """Describe the exit code of a process."""
    return f"with exit code {code}" if code >= 0 else f"by {signal.Signals(-code).name}"


def _worker(
    pipe: connection.Connection,
    load: Callable[[], Study],
    folder: Path,
    names: Collection[str],
    run_cell: RunCell,
) -> None:
    """Run cells in a process of its own, which ends when the pipe to the parent closes."""
    os.setpgid(0, 0)  # Ctrl-C reaches only the parent, which then sends SIGTERM
    threading.Thread(target=_exit_with_parent, args=(pipe,), daemon=True).start()
    logged = functools.partial(_logged, folder, run_cell)
    try:
        with sigterm_as_interrupt():
            work(load(), folder, names, logged, lambda *event: pipe.send(event))
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def _exit_with_parent(pipe: connection.Connection) -> None:
    """Wait until the parent has gone, then exit at once."""
    with contextlib.suppress(EOFError, OSError):
        pipe.recv()
    os._exit(1)


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
