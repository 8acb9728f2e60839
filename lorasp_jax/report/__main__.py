"""Rebuild the report of a run, or film its active ranks: `python -m lorasp_jax.report --help`."""

import argparse
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.console import Console

from lorasp_jax.base.errors import run_command

RANK_MAP = "rank-map"


def main(arguments: Sequence[str], program: str = "python -m lorasp_jax.report") -> int:
    """Write a run's report.html or rank maps; return an exit code of `base.errors`."""
    if [*arguments[:1]] == [RANK_MAP]:  # parsed before slow imports
        options = rank_map_parser(f"{program} {RANK_MAP}").parse_args(arguments[1:])
        write, what = _rank_maps, "rank map"
    else:
        options = parser(program).parse_args(arguments)
        write, what = _report, "report"

    def show() -> None:
        for path in write(options):
            Console().print(f"{what}: {path}", soft_wrap=True, highlight=False, markup=False)

    return run_command(show)


def _report(options: argparse.Namespace) -> Iterable[Path]:
    from lorasp_jax.report.html import write_report

    return [write_report(options.run)]


def _rank_maps(options: argparse.Namespace) -> Iterable[Path]:
    from lorasp_jax.base import compilation_cache as cache
    from lorasp_jax.evaluation import rank_map

    cache.enable()
    return rank_map.write(options.run, options.task)


def parser(program: str) -> argparse.ArgumentParser:
    """Return the argument parser of the report."""
    parser = argparse.ArgumentParser(
        prog=program,
        description="Rebuild a run's report.html from the files in its folder.",
        epilog=f"To film a run's active ranks: {program} {RANK_MAP} --help",
    )
    _add_run(parser)
    return parser


def rank_map_parser(program: str) -> argparse.ArgumentParser:
    """Return the argument parser of rank maps."""
    parser = argparse.ArgumentParser(
        prog=program,
        description="Film an evaluated episode of every task, each image patch tinted by its "
        "active rank, to rank_map_<task>.mp4 in the run's folder.",
    )
    _add_run(parser)
    parser.add_argument("--task", help="film only this task")
    return parser


def _add_run(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, help="folder of the run, such as runs/multitask")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
