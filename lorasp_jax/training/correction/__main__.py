"""Train the correction head of a run: `python -m lorasp_jax.training.correction --help`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from lorasp_jax.base.errors import parse_arguments, run_command


def main(
    arguments: Sequence[str], program: str = "python -m lorasp_jax.training.correction"
) -> int:
    """Train and save a head; return the exit code, one of `lorasp_jax.base.errors`."""
    options = parse_arguments(parser(program), arguments)
    return run_command(lambda: _train(options.run), Console(stderr=True))


def _train(run: Path) -> None:
    from lorasp_jax.base import compilation_cache as cache
    from lorasp_jax.base.bars import bars
    from lorasp_jax.training.correction.run import train

    cache.enable()
    with bars(Console(stderr=True), "steps") as progress:
        bar = progress.add_task("", total=None)
        report = lambda text, done, total: progress.update(  # noqa: E731
            bar, description=text, completed=done, total=total
        )
        error = train(run, report)
    print(
        f"error of normalized actions on held-out demonstrations: {error['naive']:.3f} without the "
        f"correction head, {error['corrected']:.3f} with it"
    )


def parser(program: str) -> argparse.ArgumentParser:
    """Define the options."""
    parser = argparse.ArgumentParser(
        prog=program,
        description="Train a small network that corrects the actions of a run's policy with the "
        "latest observation, for `lorasp-jax latency --executions corrected`. Needs the "
        "demonstrations that the run was trained on. Replaces the head of an earlier command.",
    )
    parser.add_argument("run", type=Path, help="folder of the run, such as runs/multitask")
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
