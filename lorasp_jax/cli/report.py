"""Rebuild the report of a run: `lorasp-jax report runs/NAME`."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from envs.cli.errors import parse_arguments, report_error


def main(arguments: Sequence[str], program: str = "lorasp-jax report") -> int:
    """Write a run's report.html; return the exit code: 0 success, 2 invalid input."""
    options = parse_arguments(parser(program), arguments)  # before slow imports
    from lorasp_jax.report.html import write_report

    try:
        path = write_report(options.run)
    except Exception as error:
        return report_error(error, Console(stderr=True))
    Console().print(f"report: {path}", soft_wrap=True, highlight=False, markup=False)
    return 0


def parser(program: str) -> argparse.ArgumentParser:
    """Return the argument parser of this command."""
    parser = argparse.ArgumentParser(
        prog=program, description="Rebuild a run's report.html from the files in its folder."
    )
    parser.add_argument("run", type=Path, help="folder of the run, such as runs/multitask")
    return parser
