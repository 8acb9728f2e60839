"""Run a study: `python -m lorasp_jax.extras.study --config FILE`, or `lorasp-jax study`."""

import argparse
import functools
import os
import sys
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

from rich.console import Console

from lorasp_jax.base.arguments import positive
from lorasp_jax.base.errors import REFUSED, run_command
from lorasp_jax.extras.study import page, progress, repeats, results
from lorasp_jax.extras.study.progress import BROKEN, CellState, Status
from lorasp_jax.extras.study.study import Results, Study, select

SCALES = ("smoke", "accelerator")
_SHARED_MEMORY = 0.9
"""Fraction of a device's memory that its workers share; their CUDA contexts need some, too."""


def main(arguments: Sequence[str], program: str = "python -m lorasp_jax.extras.study") -> int:
    """Run a study and return the exit code.

    0: all cells that can run are finished; 2: invalid input, or a cell failed, is damaged or has
    other settings; 130: stopped by a signal.
    """
    options = parser(program).parse_args(arguments)
    interrupted = "stopped; to resume, give the same command"
    return run_command(lambda: _execute(options, Console()), interrupted=interrupted)


def parser(program: str) -> argparse.ArgumentParser:
    """Return this command's argument parser."""
    parser = argparse.ArgumentParser(
        prog=program, description="Run the missing cells of a study and collect all results."
    )
    add = parser.add_argument
    add("--config", type=Path, required=True, help="study file with get_study(scale)")
    add("--scale", choices=SCALES, default="accelerator", help="size preset (default: accelerator)")
    which = parser.add_mutually_exclusive_group().add_argument
    text = "cells to run, such as 'pi0/multi/*'"
    which("--only", metavar="PATTERN", nargs="+", default=["*"], help=text)
    text = "finished cells to run again, beside their results"
    which("--rerun", metavar="PATTERN", nargs="+", help=text)
    add("--jobs", type=positive, default=1, metavar="N", help="processes that share the device")
    add("--shard", type=_shard, default=(1, 1), metavar="I/N", help="run the I-th of N parts")
    add("--dry-run", action="store_true", help="list the cells, then exit")
    add("--no-run", action="store_true", help="run no cell, but write the results")
    text = "parent of the study's folder (default: runs)"
    add("--out", type=Path, default=Path("runs"), help=text)
    text = "results to start from, and to add to; its README.md gets the new tables and figures"
    add("--results", type=Path, metavar="FILE", help=text)
    return parser


def _execute(options: argparse.Namespace, console: Console) -> int:
    """List or run the selected cells, then write the results of all finished ones."""
    load = functools.partial(results.load_study, options.config, options.scale, options.results)
    study = whole = load()
    folder = home = options.out / study.name
    names = select(study, options.rerun or options.only, options.shard)
    if options.rerun:
        load = functools.partial(repeats.load, load, home)
        study = load()
        names = repeats.with_sources(study, names)
        folder = repeats.next_round(home, names)
    if options.dry_run:
        statuses = progress.read(study, folder)
        for name in names:
            _print(console, f"{name}: {statuses[name].state} {statuses[name].reason}")
        _print(console, _totals(study, names, statuses))
        return 0
    if not options.no_run:
        _run(load, study, folder, names, options.jobs)
    statuses = progress.read(study, folder)
    # Only after a run is it news that a cell still waits.
    reported = BROKEN if options.no_run else {*BROKEN, CellState.WAITING}
    for name in names:
        if statuses[name].state in reported:
            _print(console, f"{name}: {statuses[name].state} {statuses[name].reason}")
    found = _write(whole, home, options.results or home / results.RESULTS_FILE, console)
    if options.rerun:
        for line in repeats.compare({name: found[name] for name in names}):
            _print(console, line)
    _print(console, _totals(study, names, statuses))
    return REFUSED if any(statuses[name].state in BROKEN for name in names) else 0


def _write(study: Study, folder: Path, path: Path, console: Console) -> Results:
    """Write the results of all finished cells and, if they suffice, the README.md beside the file.

    Returns:
        The results.

    Raises:
        ValueError: results that the study started from would be lost.
    """
    statuses = progress.read(study, folder)
    found = repeats.collect(progress.results_of(statuses, statuses), study.finished, folder)
    for name in sorted(study.finished.keys() - found.keys()):
        why = f"is {statuses[name].state}" if name in statuses else "is not in the study"
        raise ValueError(f"{path} is left as it is: it has results of {name}, which {why}")
    path.parent.mkdir(parents=True, exist_ok=True)
    results.write(path, study.name, found)
    _print(console, f"written: {path}")
    readme = path.with_name("README.md")
    suffices = study.partial or len(found) == len(study.cells)
    if study.page and readme.exists() and suffices:
        page.fill(readme, study.page(study, results.load(path), path.parent))
        _print(console, f"written: {readme}")
    return found


def _totals(study: Study, names: Collection[str], statuses: Mapping[str, Status]) -> str:
    """Count the named cells by state on one line."""
    counts = Counter(statuses[name].state for name in names)
    parts = [f"{counts[state]} {state}" for state in CellState if counts[state]]
    return f"{study.name}: {', '.join(parts)}"


def _print(console: Console, line: str) -> None:
    console.print(line, highlight=False, markup=False, soft_wrap=True)


def _run(
    load: Callable[[], Study], study: Study, folder: Path, names: list[str], jobs: int
) -> None:
    """Run cells in worker processes, failed ones once more."""
    for name in names:
        progress.clear_failure(folder / name)
    statuses = progress.read(study, folder)
    if all(statuses[name].state is not CellState.RUNNABLE for name in names):
        return
    from lorasp_jax.extras.study.workers import run_workers

    if jobs > 1:  # by default, the first process takes most of the device's memory
        os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", f"{_SHARED_MEMORY / jobs:.3f}")
    run_workers(load, folder, names, jobs)


def _shard(text: str) -> tuple[int, int]:
    """Parse a shard such as 2/4."""
    index, _, count = text.partition("/")
    if not (index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count)):
        raise argparse.ArgumentTypeError(f"must be I/N with 1 <= I <= N, got {text!r}")
    return int(index), int(count)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
