"""Evaluate runs under latency: `python -m lorasp_jax.extras.latency --help`."""

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from lorasp_jax.base.errors import run_command
from lorasp_jax.base.files import check_local
from lorasp_jax.extras.latency import curve, figure
from lorasp_jax.extras.latency.execution import EXECUTIONS, Execution, check_delay
from lorasp_jax.extras.study import Study
from lorasp_jax.extras.study.study import Results
from lorasp_jax.extras.study.workers import run_here
from lorasp_jax.training.export import describe
from lorasp_jax.training.finished_run import recorded_config

MAX_DELAY = 8
"""Largest delay measured by default [control steps], if chunks are long enough."""


def main(arguments: Sequence[str], program: str = "python -m lorasp_jax.extras.latency") -> int:
    """Measure runs and draw the figure; return the exit code, one of `lorasp_jax.base.errors`."""
    options = parser(program).parse_args(arguments)
    interrupted = "interrupted; the same command continues"
    return run_command(lambda: _measure(options), interrupted=interrupted)


def _measure(options: argparse.Namespace) -> None:
    """Measure every run; write the figure of all."""
    path = options.figure or options.runs[0] / "latency.svg"
    check_local(path)
    studies = [_study(run, options) for run in options.runs]
    curves = list[tuple[str, Results]]()
    for run, study in zip(options.runs, studies, strict=True):
        results = run_here(study, run / study.name, [cell.name for cell in study.cells])
        curves.append((run.name, results))
        print(f"written: {run / study.name}")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.write(path, curves)
    print(f"written: {path}")


def _study(run: Path, options: argparse.Namespace) -> Study:
    """Return the study of a run's points; raise ValueError if the options do not fit the run."""
    config = recorded_config(run)
    if unknown := [task for task in options.tasks if task not in config.tasks]:
        raise ValueError(f"the tasks of {run} are {', '.join(config.tasks)}, got {unknown[0]!r}")
    if options.episodes < 0 or not 0 < options.guidance < math.inf:
        raise ValueError("--episodes must be at least 0, and --guidance above 0")
    chunk = describe(run)["policy"]["config"]["chunk"]
    steps = options.execute_steps or math.ceil(chunk / 2)
    if not 1 <= steps <= chunk:
        raise ValueError(f"execute_steps must be from 1 to the chunk length ({chunk}), got {steps}")
    delays = options.delays or range(min(MAX_DELAY, steps, chunk - steps) + 1)
    for delay in delays:
        check_delay(delay, steps, chunk)
    limit = config.optim.rtc_max_delay
    if "trained" in options.executions and not limit:
        raise ValueError(f"{run} was not trained for execution trained: --optim.rtc-max-delay is 0")
    names = options.executions or [name for name in EXECUTIONS if limit or name != "trained"]
    if "trained" in names and max(delays) > limit:
        print(f"{run}: trained execution beyond d = {limit} is beyond its --optim.rtc-max-delay")
    executions = [Execution(name, steps, options.guidance) for name in names]
    tasks = options.tasks or config.tasks
    return Study("latency", curve.cells(run, tasks, executions, delays, options.episodes))


def parser(program: str) -> argparse.ArgumentParser:
    """Define the options."""
    parser = argparse.ArgumentParser(
        prog=program,
        description="Measure success and smoothness of runs whose chunks arrive late. Writes "
        "latency/results.json into each run's folder, and a figure. Continues where an earlier "
        "command stopped.",
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
    add("--guidance", type=float, default=Execution.guidance, metavar="BETA", help=text)
    text = "file to draw (default: latency.svg in the first run's folder)"
    add("--figure", type=Path, metavar="FILE", help=text)
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
