"""Run a study: `python -m lorasp_jax.extras.study --config FILE`, or `lorasp-jax study`."""

import argparse
import functools
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from lorasp_jax.base.arguments import positive
from lorasp_jax.base.errors import REFUSED, parse_arguments, run_command
from lorasp_jax.extras.study import listing, results
from lorasp_jax.extras.study.status import (
    BROKEN,
    Board,
    State,
    Status,
    clear_failure,
    results_of,
    tidy,
)
from lorasp_jax.extras.study.study import Study, select

SCALES = ("smoke", "accelerator")
_SHARED_MEMORY = 0.9
"""Fraction of a device's memory that its workers share; their CUDA contexts need some, too."""


def main(arguments: Sequence[str], program: str = "python -m lorasp_jax.extras.study") -> int:
    """Run a study and return the exit code.

    0: all cells that can run are finished; 2: invalid input, or a cell failed, is damaged or has
    other settings; 130: stopped by a signal.
    """
    options = parse_arguments(parser(program), arguments)
    interrupted = "stopped; to resume, give the same command"
    return run_command(lambda: _execute(options, Console()), Console(stderr=True), interrupted)


def parser(program: str) -> argparse.ArgumentParser:
    """Return this command's argument parser."""
    parser = argparse.ArgumentParser(
        prog=program, description="Run the missing cells of a study and collect all results."
    )
    add = parser.add_argument
    add("--config", type=Path, required=True, help="study file with get_study(scale)")
    add("--scale", choices=SCALES, default="accelerator", help="size preset (default: accelerator)")
    text = "cells to run, such as 'pi0/multi/*'"
    add("--only", metavar="PATTERN", nargs="+", default=["*"], help=text)
    add("--jobs", type=positive, default=1, metavar="N", help="processes that share the device")
    add("--shard", type=_shard, default=(1, 1), metavar="I/N", help="run the I-th of N parts")
    add("--dry-run", action="store_true", help="list the cells, then exit")
    add("--no-run", action="store_true", help="run no cell, but write results and page")
    add(
        "--out",
        type=Path,
        default=Path("runs"),
        help="parent of the study's folder (default: runs)",
    )
    text = "results to start from; all results are written there, and the page beside it"
    add("--results", type=Path, metavar="FILE", help=text)
    return parser


def _execute(options: argparse.Namespace, console: Console) -> int:
    """List or run the selected cells, then write the results of all finished ones."""
    study = results.load_study(options.config, options.scale, options.results)
    folder, names = options.out / study.name, select(study, options.only, options.shard)
    board = Board(study, folder)
    if options.dry_run:
        statuses = board.read()
        console.print(listing.dry_run_table(study, names, statuses))
        _print(console, listing.totals(study, names, statuses))
        return 0
    if not options.no_run:
        _run(options, board, folder, names, console)
    statuses = board.read()
    # Only after a run is it news that a cell still waits.
    _print(console, *listing.problems(names, statuses, waiting=not options.no_run))
    path = _write(study, options.results or folder / results.RESULTS_FILE, statuses)
    _print(console, listing.totals(study, names, statuses), f"see {path}")
    return REFUSED if any(statuses[name].state in BROKEN for name in names) else 0


def _write(study: Study, path: Path, statuses: dict[str, Status]) -> Path:
    """Write the results of all finished cells and, if the study has claims, the page on them.

    Raises:
        ValueError: results that the study started from would be lost.
    """
    found = results_of(statuses, statuses)
    for name in sorted(study.finished.keys() - found.keys()):
        why = f"is {statuses[name].state}" if name in statuses else "is not in the study"
        raise ValueError(f"{path} is left as it is: it has results of {name}, which {why}")
    path.parent.mkdir(parents=True, exist_ok=True)
    results.write(path, study.name, found)
    if study.page is not None:
        study.page(study, results.load(path), path.parent)
    return path


def _print(console: Console, *lines: str) -> None:
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def _run(
    options: argparse.Namespace, board: Board, folder: Path, names: list[str], console: Console
) -> None:
    """Run cells in worker processes, failed ones once more."""
    for name in names:
        clear_failure(folder / name)
    statuses = board.read()
    for name in names:
        if statuses[name].state is State.FINISHED:
            tidy(folder / name)  # the last process may have been killed before it did
    if all(statuses[name].state is not State.RUNNABLE for name in names):
        return
    from lorasp_jax.extras.study.workers import Workers

    if options.jobs > 1:  # by default, the first process takes most of the device's memory
        share = f"{_SHARED_MEMORY / options.jobs:.3f}"
        os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", share)
    load_study = functools.partial(
        results.load_study, options.config, options.scale, options.results
    )
    Workers(load_study, folder, names, console).run(options.jobs)


def _shard(text: str) -> tuple[int, int]:
    """Parse a shard such as 2/4."""
    index, _, count = text.partition("/")
    if not (index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count)):
        raise argparse.ArgumentTypeError(f"must be I/N with 1 <= I <= N, got {text!r}")
    return int(index), int(count)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
