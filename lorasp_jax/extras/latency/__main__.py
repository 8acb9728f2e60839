"""Evaluate runs under latency: `python -m lorasp_jax.extras.latency --help`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from lorasp_jax.base import compilation_cache as cache
from lorasp_jax.base.bars import bars
from lorasp_jax.base.errors import parse_arguments, run_command
from lorasp_jax.base.files import check_local
from lorasp_jax.extras.latency import figure
from lorasp_jax.extras.latency.curve import FILE, MAX_DELAY, Options, extrapolated, measure
from lorasp_jax.extras.latency.execution import EXECUTIONS


def main(arguments: Sequence[str], program: str = "python -m lorasp_jax.extras.latency") -> int:
    """Measure runs and draw the figure; return the exit code, one of `lorasp_jax.base.errors`."""
    options = parse_arguments(parser(program), arguments)
    interrupted = f"interrupted; {FILE} has what was measured, and the same command continues"
    return run_command(lambda: _measure(options), Console(stderr=True), interrupted)


def _measure(options: argparse.Namespace) -> None:
    """Measure every run; write the figure of all."""
    path = options.figure or options.runs[0] / "latency.svg"
    check_local(path)
    cache.enable()
    names = ("executions", "delays", "tasks", "episodes", "execute_steps", "guidance")
    chosen = Options(**{name: getattr(options, name) for name in names})
    curves = []
    for run in options.runs:
        with bars(Console(stderr=True), "points") as progress:
            curves.append((run.name, measure(run, chosen, progress)))
        if beyond := extrapolated(run, curves[-1][1]):
            text = ", ".join(map(str, beyond))
            print(f"{run}: trained execution at d = {text} is beyond its --optim.rtc-max-delay")
    figure.write(path, curves)
    for written in (*(run / FILE for run in options.runs), path):
        print(f"written: {written}")


def parser(program: str) -> argparse.ArgumentParser:
    """Define the options."""
    parser = argparse.ArgumentParser(
        prog=program,
        description=f"Measure success and smoothness of runs whose chunks arrive late. Writes "
        f"{FILE} into each run's folder, and a figure. Continues where an earlier command stopped.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="executions:\n" + "\n".join(f"  {k:12} {v}" for k, v in EXECUTIONS.items()),
    )
    add = parser.add_argument
    add("runs", type=Path, nargs="+", metavar="run", help="folders of runs, such as runs/multitask")
    text = "how the robot executes chunks (default: all that the policy supports)"
    add("--executions", nargs="+", choices=EXECUTIONS, default=(), metavar="NAME", help=text)
    text = f"delays in control steps (default: from 0 to the longest possible, at most {MAX_DELAY})"
    add("--delays", nargs="+", type=int, default=(), metavar="D", help=text)
    add("--tasks", nargs="+", default=(), metavar="TASK", help="tasks (default: all of the run)")
    text = "episodes per task and point (default: as in the run's evaluation)"
    add("--episodes", type=int, default=0, metavar="N", help=text)
    text = "control steps between observations (default: half of the chunk)"
    add("--execute-steps", type=int, default=0, metavar="N", help=text)
    text = "limit of the guidance weight (default: %(default)s)"
    add("--guidance", type=float, default=Options.guidance, metavar="BETA", help=text)
    text = "file to draw (default: latency.svg in the first run's folder)"
    add("--figure", type=Path, metavar="FILE", help=text)
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
