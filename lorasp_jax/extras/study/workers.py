"""Run a study in several processes on one device, with one progress bar over all cells."""

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from multiprocessing import connection, context
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn

from lorasp_jax.base.errors import INTERRUPTED
from lorasp_jax.extras.study import forecast, status
from lorasp_jax.extras.study.runner import Job, RunCell, work
from lorasp_jax.extras.study.status import Board, State, Status
from lorasp_jax.extras.study.study import Study
from lorasp_jax.training.interrupt import sigterm_as_interrupt

_REFRESH = 1.0  # s
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
        self._board, self._console = Board(self._study, folder), console
        self._running: dict[context.SpawnProcess, tuple[connection.Connection, list[str]]] = {}
        self._started: dict[str, float] = {}
        self._finished: set[str] = set()
        self._finish_time: float | None = None

    def run(self, count: int) -> None:
        """Run `count` workers until they have nothing left to do.

        Raises:
            ValueError: a worker died outside a cell.
            KeyboardInterrupt: a signal arrived; the workers were told to save and stop.
        """
        columns = "{task.description}", BarColumn(), MofNCompleteColumn(), "{task.fields[left]}"
        columns = [TextColumn(c) if isinstance(c, str) else c for c in columns]
        for _ in range(count):
            self._start()
        with self._stopping(), Progress(*columns, console=self._console) as progress:
            bar = progress.add_task("cells", total=len(self._names), left="")
            self._show(progress, bar)
            while self._running:
                pipes = {pipe: worker for worker, (pipe, _) in self._running.items()}
                for pipe in connection.wait(list(pipes), timeout=_REFRESH):
                    assert isinstance(pipe, connection.Connection)
                    self._receive(pipes[pipe], pipe)
                    self._show(progress, bar)
                progress.update(bar, left=self._time_left())

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
            self._started[name] = time.monotonic()
            return
        cells.remove(name)
        del self._started[name]
        self._finished.add(name)
        self._print(name)

    def _handle_exit(self, code: int | None, cells: list[str]) -> None:
        """After a worker died, fail the cell that it ran and start another worker."""
        if code == INTERRUPTED:
            raise KeyboardInterrupt
        if code and not cells:
            raise ValueError(f"a worker stopped {_how(code)} outside of a cell")
        for name in cells:
            reason = f"the worker stopped {_how(code or 0)}"
            status.record_failure(self._folder / name, reason, "")
            del self._started[name]
            self._print(name)
            self._start()

    def _print(self, name: str) -> None:
        """Print on one line how a cell ended."""
        current = self._board.read()[name]
        text = f"{name}: {current.state} {current.reason}"
        if current.result:
            text = f"{name}: {forecast.summary(current.result)}"
        style = "red" if current.state in status.BROKEN else None
        self._console.print(text, style=style, highlight=False, markup=False, soft_wrap=True)

    def _show(self, progress: Progress, bar: TaskID) -> None:
        """Count the finished cells and estimate when the others will be."""
        statuses = self._board.read()
        done = [name for name in self._names if statuses[name].state is State.FINISHED]
        now = time.monotonic()
        ages = {name: now - start for name, start in self._started.items()}
        seconds = self._expected_seconds(statuses, ages)
        self._finish_time = None if seconds is None else now + seconds
        progress.update(bar, completed=len(done), description=", ".join(ages) or "cells")

    def _expected_seconds(
        self, statuses: Mapping[str, Status], ages: Mapping[str, float]
    ) -> float | None:
        """Estimate the time until all cells that can run are finished [s]; None if unknown.

        `ages` has the times for which cells have been running.
        """
        jobs = max(len(self._running), 1)
        times = forecast.seconds(self._study, statuses, self._finished, jobs)
        left = {*forecast.left(self._study, self._names, statuses)} & times.keys()
        rest = [max(times[name] - ages.get(name, 0.0), 0.0) for name in left]
        return max(sum(rest) / jobs, *rest) if left else None

    def _time_left(self) -> str:
        """Return the estimated time until all cells are finished."""
        if self._finish_time is None:
            return ""
        return f"about {forecast.duration(max(self._finish_time - time.monotonic(), 0.0))} left"

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

    def logged(job: Job) -> dict:
        with _output_to(folder / "logs" / f"{job.cell.name}.txt"):
            return run_cell(job)

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
