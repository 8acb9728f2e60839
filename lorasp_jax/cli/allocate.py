"""Plan ranks by layer from a finished run: `lorasp-jax allocate`."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from lorasp_jax.base import arguments as types
from lorasp_jax.base.errors import run_command


def main(arguments: Sequence[str], program: str = "lorasp-jax allocate") -> int:
    """Write a plan; return the exit code, one of `lorasp_jax.base.errors`."""
    options = parser(program).parse_args(arguments)
    return run_command(lambda: _run(options))


def parser(program: str) -> argparse.ArgumentParser:
    """Return the argument parser of this command."""
    parser = argparse.ArgumentParser(
        prog=program,
        description="Plan ranks by layer for LoRA or DoRA, in proportion to the mean active ranks "
        "of a finished LoRA-SP or AdaLoRA run. See docs/deployment.md.",
    )
    add = parser.add_argument
    add("run", type=Path, help="folder of a finished run, such as runs/multitask")
    add("--out", type=Path, required=True, metavar="FILE", help="plan to write, for train --plan")
    text = "as many parameters as with this rank in every layer (default: the run's active rank)"
    add("--rank", type=types.not_negative, metavar="MEAN", help=text)
    add("--least", type=types.positive, default=1, metavar="N", help="smallest rank (default: 1)")
    text = "give the N layers with the lowest active rank no adapter (default: 0)"
    add("--drop", type=int, default=0, metavar="N", help=text)
    return parser


def _run(options: argparse.Namespace) -> None:
    from lorasp_jax.training.allocation import from_run, shapes
    from lorasp_jax.training.export import RecordedPolicy

    if options.out.exists():
        raise ValueError(f"{options.out} exists already: choose another --out")
    plan = from_run(options.run, rank=options.rank, least=options.least, drop=options.drop)
    plan.save(options.out)
    ranks = [rank for each in plan.ranks.values() for rank in each]
    config = RecordedPolicy.read(options.run).config
    count = plan.count(shapes(config, frozenset(plan.ranks)))
    print(
        f"written: {options.out}, ranks from {min(ranks)} to {max(ranks)} in {len(ranks)} layers, "
        f"{count:,} of at most {plan.budget:,} parameters"
    )
