"""Adapt a policy to a robot: `python train.py --config configs/multitask.py`."""

import sys
from pathlib import Path

from rich.console import Console

from envs import physics


def main(arguments: list[str]) -> int:
    """Run one experiment; returns the exit code: 0 done, 2 bad input, 130 stopped by a signal."""
    console = Console()
    physics.enable_fast_cpu()  # before anything starts a JAX backend
    physics.enable_compilation_cache()
    from lorasp_jax.training.interrupt import sigterm_as_interrupt
    from lorasp_jax.training.overrides import parse
    from lorasp_jax.training.run_folder import open_run

    try:
        config, resume = parse(arguments)
        folder = open_run(config, Path("runs"), resume=resume)
        with sigterm_as_interrupt():
            run(config, folder, console, resume=resume)
    except ValueError as error:
        console.print(f"error: {error}", style="red", soft_wrap=True, highlight=False)
        return 2
    except KeyboardInterrupt:
        again = " ".join(argument for argument in arguments if argument != "--resume")
        console.print(f"stopped; to go on: python train.py {again} --resume", soft_wrap=True)
        return 130
    return 0


def run(config, folder: Path, console: Console, *, resume: bool) -> None:
    """Train with evaluation before and after, export the adapters and write the report."""
    from lorasp_jax.evaluation.callback import Evaluation
    from lorasp_jax.report.html import write_report
    from lorasp_jax.training import export, loop, setup

    prepared = setup.prepare(config, folder, console)
    loop.train(prepared, [Evaluation()], resume=resume)
    export.write(prepared)
    report = write_report(folder)
    console.print(f"finished in {prepared.elapsed:.0f} s: {report}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
