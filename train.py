"""Adapt a policy to a robot: `python train.py --config configs/multitask.py`."""

import os
import shlex
import sys
import time
from pathlib import Path

from rich.console import Console

from envs import physics

RUNS = Path("runs")
STOPPED = 130
"""Exit code after a signal, as shells have it."""


def main(arguments: list[str]) -> int:
    """Run one experiment; returns the exit code: 0 done, 2 bad input, 130 stopped by a signal."""
    started = time.perf_counter()
    console, errors = Console(), Console(stderr=True)
    physics.enable_fast_cpu()  # before anything starts a JAX backend
    physics.enable_compilation_cache()
    from lorasp_jax.training.interrupt import sigterm_as_interrupt
    from lorasp_jax.training.overrides import parse
    from lorasp_jax.training.run_folder import open_run

    try:
        command = parse(arguments)
        config, resume = command.config, command.resume
        if command.dry_run:
            from lorasp_jax.training.dry_run import dry_run

            dry_run(config, RUNS / config.name, console)
            return 0
        folder = open_run(config, RUNS, resume=resume)
        report = folder / "report.html"
        if resume and report.exists():
            console.print(f"this run is finished: {report}", markup=False)
            return 0
        with sigterm_as_interrupt():
            run(config, folder, console, started, resume=resume)
    except ValueError as error:
        errors.print(f"error: {error}", style="red", soft_wrap=True, highlight=False, markup=False)
        return 2
    except KeyboardInterrupt:
        again = shlex.join(argument for argument in arguments if argument != "--resume")
        message = f"stopped; to go on: python train.py {again} --resume"
        errors.print(message, soft_wrap=True, highlight=False, markup=False)
        return STOPPED
    return 0


def run(config, folder: Path, console: Console, started: float, *, resume: bool) -> None:
    """Train with evaluation before and after, export the adapters and write the report."""
    from lorasp_jax.evaluation.callback import Evaluation, NoEvaluation
    from lorasp_jax.report.html import write_report
    from lorasp_jax.training import export, loop, setup

    prepared = setup.prepare(config, folder, console, started)
    evaluation = Evaluation() if prepared.simulated else NoEvaluation()
    loop.train(prepared, [evaluation], resume=resume)
    export.write(prepared)
    report = write_report(folder)
    console.print(f"finished in {prepared.seconds['total']:.0f} s: {report}", markup=False)


if __name__ == "__main__":
    code = main(sys.argv[1:])
    if code:
        sys.stdout.flush()
        os._exit(code)  # threads that still compile cannot be stopped, and would be waited for
