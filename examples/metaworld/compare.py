"""Compare methods on Meta-World: train and judge what is missing, then write docs/metaworld.md.

    python -m examples.metaworld.compare --judge ~/metaworld/bin/python

Needs the demonstrations of `python -m examples.metaworld.collect` in data/mt50, data/ml45 and
data/ml5. Stopped at any moment, the same command goes on. `--no-run` writes the page again.
"""

import argparse
import concurrent.futures
import contextlib
import fnmatch
import json
import os
import queue
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO

from examples.metaworld import page
from examples.metaworld.cells import Cell, cells

FIRST_PORT = 8100
LOGS = Path("runs/metaworld_logs")
POLL = 1.0
"""Time between two looks at a judge and its server [s]."""


class Runner:
    """Runs cells, each in processes of its own; several threads may use it."""

    def __init__(self, options: argparse.Namespace) -> None:
        """Start nothing; `options` are the command's."""
        self._options = options
        self._places = queue.SimpleQueue[int]()
        for place in range(options.jobs):
            self._places.put(place)

    def finish(self, cell: Cell, base: concurrent.futures.Future | None) -> None:
        """Train and judge a cell, as soon as the base that it starts from is trained.

        Raises:
            ValueError: a command failed.
        """
        if base:
            base.result()
        with self._place() as place:
            started = time.perf_counter()
            self._train(cell, place)
            trained = time.perf_counter()
            self._judge(cell, place)
        times = trained - started, time.perf_counter() - trained
        print(f"{cell.name}: trained in {times[0]:.0f} s, judged in {times[1]:.0f} s", flush=True)

    def make_base(self, cell: Cell) -> None:
        """Train a policy that others start from, unless that is done.

        Raises:
            ValueError: the command failed.
        """
        if not (cell.run / "base").exists():
            with self._place() as place:
                self._train(cell, place)

    @contextlib.contextmanager
    def _place(self) -> Iterator[int]:
        """Take the number of a free job, which decides its GPU and port."""
        place = self._places.get()
        try:
            yield place
        finally:
            self._places.put(place)

    def _train(self, cell: Cell, place: int) -> None:
        command = cell.train(self._options.data, self._options.train)
        with _log(cell) as log:
            code = self._start(command, place, log).wait()
        _check(cell, "training", code)

    def _judge(self, cell: Cell, place: int) -> None:
        options, port = self._options, FIRST_PORT + place
        judge = cell.judge(options.judge, port, options.episodes, options.processes)
        with _log(cell) as log:
            server = self._start(cell.serve(port), place, log)
            judging = self._start(judge, place, log)
            try:
                while judging.poll() is None:
                    _check(cell, "serving", server.poll() or 0)
                    time.sleep(POLL)
            finally:
                for process in (judging, server):
                    process.terminate()
                    process.wait()
        _check(cell, "judging", judging.returncode)

    def _start(self, command: Sequence[str], place: int, log: IO[str]) -> subprocess.Popen:
        return subprocess.Popen(command, stdout=log, stderr=log, env=self._environment(place))

    def _environment(self, place: int) -> Mapping[str, str]:
        """Return the environment of a job's processes, which share the GPUs."""
        if not self._options.gpus:
            return os.environ
        gpu = str(place % self._options.gpus)
        share = 0.9 * self._options.gpus / max(self._options.jobs, self._options.gpus)
        return {
            "XLA_PYTHON_CLIENT_MEM_FRACTION": f"{share:.3f}",
            **os.environ,
            "CUDA_VISIBLE_DEVICES": gpu,
            "MUJOCO_EGL_DEVICE_ID": gpu,
        }


def _log(cell: Cell) -> IO[str]:
    LOGS.mkdir(parents=True, exist_ok=True)
    return (LOGS / f"{cell.name}.txt").open("a")


def _check(cell: Cell, what: str, code: int) -> None:
    if code:
        raise ValueError(f"{what} of {cell.name} failed: see {LOGS / cell.name}.txt")


def main(arguments: Sequence[str]) -> int:
    """Run the missing cells and write the page; return the exit code."""
    options = _parser().parse_args(arguments)
    chosen = [c for c in cells(options.backbones) if fnmatch.fnmatchcase(c.name, options.only)]
    failed = 0 if options.no_run else _run(options, chosen)
    found = json.loads(options.results.read_text()) if options.results.exists() else {}
    found |= {cell.name: cell.result() for cell in chosen if cell.judged.exists()}
    options.results.write_text(page.dumps(found))
    page.write(found, options.page)
    print(f"{len(found)} policies in {options.results}; written: {options.page}")
    return 1 if failed else 0


def _run(options: argparse.Namespace, chosen: Sequence[Cell]) -> int:
    """Run the cells that are not finished; return how many failed."""
    runner, failed = Runner(options), 0
    missing = [cell for cell in chosen if not cell.judged.exists()]
    bases = dict.fromkeys(cell.base for cell in missing if cell.base)
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        made = {base: pool.submit(runner.make_base, base) for base in bases}
        jobs = [pool.submit(runner.finish, c, c.base and made[c.base]) for c in missing]
        for job in concurrent.futures.as_completed(jobs):
            try:
                job.result()
            except ValueError as error:
                print(f"error: {error}", file=sys.stderr)
                failed += 1
    return failed


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m examples.metaworld.compare")
    add = parser.add_argument
    add("--judge", metavar="PYTHON", default="", help="Python in which metaworld is installed")
    add("--data", type=Path, default=Path("data"), help="folder of the demonstrations")
    add("--backbones", nargs="+", choices=("pi0", "smolvla"), default=["pi0", "smolvla"])
    add("--only", default="*", metavar="PATTERN", help="policies to run, such as '*_mt50_*'")
    add("--jobs", type=int, default=1, metavar="N", help="policies that are made at once")
    add("--gpus", type=int, default=0, metavar="N", help="GPUs that the jobs share")
    add("--episodes", type=int, default=10, metavar="N", help="episodes per task")
    add("--processes", type=int, default=2, metavar="N", help="processes that judge a policy")
    add("--results", type=Path, default=Path("docs/metaworld.json"), metavar="FILE")
    add("--page", type=Path, default=Path("docs/metaworld.md"), metavar="FILE")
    add("--no-run", action="store_true", help="run nothing, but write results and page")
    add("train", nargs="*", help="more options of train.py, after --")
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
