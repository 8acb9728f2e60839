"""Write the report of a run again: `lorasp-jax report runs/NAME`."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from envs.cli.refusals import parsed, refused


def main(arguments: Sequence[str], program: str = "lorasp-jax report") -> int:
    """Write report.html of a run; returns the exit code: 0 done, 2 bad input."""
    options = parsed(parser(program), arguments)  # before the slow imports
    from lorasp_jax.report.html import write_report

    try:
        path = write_report(options.run)
    except Exception as error:
        return refused(error, Console(stderr=True))
    Console().print(f"report: {path}", soft_wrap=True, highlight=False, markup=False)
    return 0


def parser(program: str) -> argparse.ArgumentParser:
    """The options of the command."""
    parser = argparse.ArgumentParser(
        prog=program, description="Write the report of a run again, from the files it has left."
    )
    parser.add_argument("run", type=Path, help="folder of a run, such as runs/multitask")
    return parser
