"""Compare or save the deployment variants of a run (`lorasp-jax deploy --help`)."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from lorasp_jax.base.errors import run_command


def main(arguments: Sequence[str], program: str = "python -m lorasp_jax.extras.deployment") -> int:
    """Measure all variants, or save one; return the exit code, one of `lorasp_jax.base.errors`."""
    options = parser(program).parse_args(arguments)
    return run_command(lambda: _run(options))


def parser(program: str) -> argparse.ArgumentParser:
    """Return the argument parser of this command."""
    parser = argparse.ArgumentParser(
        prog=program,
        description="Compare forms in which a run can be deployed, or save one of them.",
        epilog="variants: whole, pruned, half, lora or merged (only whole and merged if the method "
        "is not LoRA-SP), then -bf16, -int8 or -nf4, such as half-int8. See docs/deployment.md.",
    )
    add = parser.add_argument
    add("run", type=Path, help="folder of a finished run, such as runs/multitask")
    add("--variants", nargs="+", default=[], metavar="VARIANT", help="default: all")
    text = "episodes per task (default: as in the run's evaluation)"
    add("--episodes", type=int, default=0, metavar="N", help=text)
    text = "calibrate, heal and measure on this task of the run alone (default: all its tasks)"
    add("--task", default="", metavar="NAME", help=text)
    add("--save", default="", metavar="VARIANT", help="write this variant instead of measuring")
    add("--out", type=Path, metavar="DIR", help="folder to write, which the policy server serves")
    text = "train the form on for this many steps, on the run's data, before it is written"
    add("--heal", type=int, metavar="STEPS", help=text)
    return parser


def _run(options: argparse.Namespace) -> None:
    from lorasp_jax.extras.deployment import measurement, variants

    if bool(options.save) != bool(options.out):
        raise ValueError("--save and --out must be given together")
    if options.save and (options.variants or options.episodes):
        raise ValueError("--variants and --episodes are for measuring: leave out --save")
    if options.heal is not None and not options.save:
        raise ValueError("--heal changes what --save writes: add --save and --out")
    if options.heal is not None and options.heal < 1:
        raise ValueError(f"--heal must be at least 1 step, got {options.heal}")
    variants.check_run(options.run, options.task, simulated=not options.save)
    if options.save:
        settings = {"heal": options.heal or 0, "task": options.task}
        found = variants.save(options.run, options.save, options.out, **settings)
        text = (
            ", calibrated on {windows} windows of {episodes} episodes ({frames} frames) of {data}"
        )
        print(f"written: {options.out}{text.format(**found) if found else ''}")
        return
    from lorasp_jax.extras.study import Study
    from lorasp_jax.extras.study.workers import run_here

    chosen = [variants.check(name, options.run) for name in options.variants]
    names = dict.fromkeys((variants.WHOLE, *chosen)) if chosen else variants.of_run(options.run)
    tasks, prefix = ((options.task,), f"{options.task}/") if options.task else ((), "")
    cells = measurement.cells(options.run, options.episodes, prefix, tasks)
    study = Study("deployment", cells, measure=measurement.measure)
    results = run_here(study, options.run / study.name, [prefix + name for name in names])
    print(measurement.table(results, prefix), end="")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
