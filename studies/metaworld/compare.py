"""Compare methods on Meta-World: train and judge what is missing, then write docs/metaworld.md.

    python -m studies.metaworld.compare --judge ~/metaworld/bin/python

Needs the demonstrations of `python -m studies.metaworld.collect` in data/mt50, data/ml45 and
data/ml5. Stopped at any moment, the same command goes on; a policy whose result is in --results is
finished, even if its run is gone. `--no-run` only writes the page again.
"""

import argparse
import concurrent.futures
import contextlib
import fnmatch
import os
import queue
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import IO, Any

from rich.console import Console

from lorasp_jax.base.arguments import positive
from lorasp_jax.base.errors import run_command
from lorasp_jax.base.writing import write_text
from lorasp_jax.training.interrupt import sigterm_as_interrupt
from studies.metaworld import page
from studies.metaworld.cells import STAGES, Cell, Results, cells

FIRST_PORT = 8100
LOGS = Path("runs/metaworld_logs")
POLL = 1.0
"""Time between two looks at a judge and its server [s]."""


class Runner:
    """Runs cells, each in processes of its own; several threads may use it."""

    def __init__(self, options: argparse.Namespace, known: dict[str, Any]) -> None:
        """Start nothing.

        Args:
            options: the command's options.
            known: results of the finished cells; those of others are added, and all are written.
        """
        self._options, self._known = options, known
        self._places = queue.SimpleQueue[int]()
        for place in range(options.jobs):
            self._places.put(place)
        self._lock, self._stopped = threading.Lock(), False
        self._running = list[subprocess.Popen]()

    def finish(self, cell: Cell, needs: Sequence[Future[None]]) -> None:
        """Train and judge a cell, as soon as the cells that it needs are finished.

        Raises:
            ValueError: a command failed, here or for a cell that it needs, or `stop` was called.
        """
        if any(need.exception() for need in needs):
            raise ValueError(f"{cell.name} needs a policy that failed")
        with self._place() as place:
            started = time.perf_counter()
            if not cell.judged.exists():
                self._train(cell, place)
            trained = time.perf_counter()
            if STAGES[cell.stage].episodes:
                if not cell.judged.exists():
                    self._judge(cell, place)
                self._add(cell)
        times = trained - started, time.perf_counter() - trained
        print(f"{cell.name}: trained in {times[0]:.0f} s, judged in {times[1]:.0f} s", flush=True)

    def stop(self) -> None:
        """Tell all processes to save and stop, and start no others."""
        with self._lock:
            self._stopped = True
            for process in self._running:
                process.terminate()

    def _add(self, cell: Cell) -> None:
        """Write the results with those of a cell, so that nothing is lost whenever this stops."""
        result = cell.result()
        with self._lock:
            self._known[cell.name] = result
            write_text(self._options.results, page.dumps(self._known))

    @contextlib.contextmanager
    def _place(self) -> Iterator[int]:
        """Take the number of a free job, which decides its GPU and port."""
        place = self._places.get()
        try:
            yield place
        finally:
            self._places.put(place)

    def _train(self, cell: Cell, place: int) -> None:
        command = cell.train(self._options.data, cell.rate(self._known))
        with _log(cell) as log, self._process(command, place, log) as process:
            _check(cell, "training", process.wait())

    def _judge(self, cell: Cell, place: int) -> None:
        port = FIRST_PORT + place
        judge = cell.judge(self._options.judge, port, self._options.processes)
        with (
            _log(cell) as log,
            self._process(cell.serve(port), place, log) as serving,
            self._process(judge, place, log) as judging,
        ):
            while judging.poll() is None:
                _check(cell, "serving", serving.poll() or 0)
                time.sleep(POLL)
            _check(cell, "judging", judging.returncode)

    @contextlib.contextmanager
    def _process(self, command: Sequence[str], place: int, log: IO[str]) -> Iterator[Any]:
        """Start a process, and end it after this block."""
        with self._lock:
            if self._stopped:
                raise ValueError("stopped")
            process = subprocess.Popen(
                command,
                stdout=log,
                stderr=log,
                env=self._environment(place),
                start_new_session=True,  # Ctrl-C reaches only this command, which then calls `stop`
            )
            self._running.append(process)
        try:
            yield process
        finally:
            process.terminate()
            process.wait()

    def _environment(self, place: int) -> Mapping[str, str]:
        """Return the environment of a job's processes, which share the GPUs."""
        jobs, gpus = self._options.jobs, self._options.gpus
        found = dict(os.environ)
        if jobs > 1:
            share = 0.9 / -(-jobs // gpus)
            found.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", f"{share:.3f}")
        if gpus > 1:
            visible = found.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(gpus)))
            found["CUDA_VISIBLE_DEVICES"] = visible.split(",")[place % gpus]
        return found


def _log(cell: Cell) -> IO[str]:
    LOGS.mkdir(parents=True, exist_ok=True)
    return (LOGS / f"{cell.name}.txt").open("a")


def _check(cell: Cell, what: str, code: int) -> None:
    if code:
        raise ValueError(f"{what} of {cell.name} failed: see {LOGS / cell.name}.txt")


def main(arguments: Sequence[str]) -> int:
    """Run the missing cells and write the page; return the exit code."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if not options.no_run and not shutil.which(options.judge):
        parser.error(f"--judge must be the Python with metaworld, got {options.judge!r}")
    stopped = "stopped; to go on, give the same command"
    return run_command(lambda: _execute(options), Console(stderr=True), stopped)


def _execute(options: argparse.Namespace) -> int:
    known = page.load(options.results)
    failed = 0 if options.no_run else _run(options, known)
    page.write(known, options.page)
    print(f"{len(known)} policies in {options.results}; written: {options.page}")
    return 1 if failed else 0


def _missing(options: argparse.Namespace, known: Results) -> list[Cell]:
    """Return the cells of --backbones and --only without results, and those that they need."""
    every = [*cells(options.backbones)]
    missing = set[Cell]()
    for cell in reversed(every):
        is_wanted = fnmatch.fnmatchcase(cell.name, options.only) and STAGES[cell.stage].episodes
        if cell.name not in known and (is_wanted or any(cell in other.needs for other in missing)):
            missing.add(cell)
    return [cell for cell in every if cell in missing]


def _run(options: argparse.Namespace, known: dict[str, Any]) -> int:
    """Run the cells that are not finished; return how many failed."""
    runner, failed, jobs = Runner(options, known), 0, dict[Cell, Future[None]]()
    with ThreadPoolExecutor(options.jobs) as pool, _stopping(runner, pool):
        for cell in _missing(options, known):
            needs = [jobs[need] for need in cell.needs if need in jobs]
            jobs[cell] = pool.submit(runner.finish, cell, needs)
        for job in concurrent.futures.as_completed(jobs.values()):
            try:
                job.result()
            except (ValueError, OSError) as error:
                print(f"error: {error}", file=sys.stderr)
                failed += 1
    return failed


@contextlib.contextmanager
def _stopping(runner: Runner, pool: ThreadPoolExecutor) -> Iterator[None]:
    """On Ctrl-C or SIGTERM in this block, let the running processes save and stop."""
    try:
        with sigterm_as_interrupt():
            yield
    except KeyboardInterrupt:
        pool.shutdown(wait=False, cancel_futures=True)
        runner.stop()
        raise


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m studies.metaworld.compare")
    add = parser.add_argument
    add("--judge", metavar="PYTHON", default="", help="Python in which metaworld is installed")
    add("--data", type=Path, default=Path("data"), help="folder of the demonstrations")
    add("--backbones", nargs="+", choices=("pi0", "smolvla"), default=["pi0", "smolvla"])
    add("--only", default="*", metavar="PATTERN", help="policies to run, such as '*_mt50_*'")
    add("--jobs", type=positive, default=1, metavar="N", help="policies that are made at once")
    add("--gpus", type=positive, default=1, metavar="N", help="GPUs that the jobs share")
    text = "processes that judge a policy (default: %(default)s)"
    add("--processes", type=positive, default=2, metavar="N", help=text)
    add("--results", type=Path, default=Path("docs/metaworld.json"), metavar="FILE")
    add("--page", type=Path, default=Path("docs/metaworld.md"), metavar="FILE")
    add("--no-run", action="store_true", help="run nothing, but write results and page")
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
