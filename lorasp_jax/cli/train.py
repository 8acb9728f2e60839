"""Adapt a policy to a robot: `lorasp-jax train`, in a checkout `python train.py`, too."""

import argparse
import contextlib
import shlex
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from envs.cli.refusals import refused
from envs.compilation import cache

if TYPE_CHECKING:
    from lorasp_jax.training.overrides import Command

RUNS = Path("runs")
STOPPED = 130
"""Exit code after a signal, as shells have it."""


def main(arguments: Sequence[str], program: str = "python train.py") -> int:
    """Run one experiment; returns the exit code.

    0: done, 2: bad input or a run that cannot go on, 130: stopped by a signal.
    """
    started = time.perf_counter()
    cache.enable()
    from lorasp_jax.training.distributed import processes
    from lorasp_jax.training.interrupt import sigterm_as_interrupt
    from lorasp_jax.training.overrides import parse
    from lorasp_jax.training.run_folder import to_json

    console, errors = Console(), processes.LastWords(stderr=True)
    try:
        with sigterm_as_interrupt():
            if "--distributed" in arguments:
                processes.initialize(console, f"to go on: {resuming(arguments, program)}")
                console.quiet = not processes.is_first()
            command = parse(arguments, program)
            options = {"resume": command.resume, "dry_run": command.dry_run}
            processes.agree("settings", to_json(command.config) | options)
            _execute(command, console, started)
    except Exception as error:  # the input's fault is told in one sentence, ours is raised again
        return refused(error, errors, ": make room and add --resume")
    except KeyboardInterrupt:
        message = f"stopped; to go on: {resuming(arguments, program)}"
        errors.print(message, soft_wrap=True, highlight=False, markup=False)
        return STOPPED
    return 0


def parser(program: str) -> argparse.ArgumentParser:
    """The options of the command, and the fields of an experiment with the default method."""
    from lorasp_jax.training import overrides

    return overrides.parser(program)


def _execute(command: "Command", console: Console, started: float) -> None:
    """A dry run, a run, or the report of one that is finished."""
    from lorasp_jax.training.distributed import processes
    from lorasp_jax.training.run_folder import open_run

    folder = RUNS / command.config.name
    if command.dry_run:
        from lorasp_jax.training.cost.dry_run import dry_run

        dry_run(command.config, folder, console)
        return
    with contextlib.ExitStack() as stack:
        with processes.first_goes_ahead("opened"):
            if processes.is_first():
                stack.enter_context(open_run(command.config, RUNS, resume=command.resume))
        if not (command.resume and (folder / "results.json").exists()):
            run(command, folder, console, started)
        elif processes.is_first():
            from lorasp_jax.report.html import write_report

            console.print(f"this run is finished: {write_report(folder)}", markup=False)


def resuming(arguments: Sequence[str], program: str) -> str:
    """The command that goes on with this run, or begins it where it had not begun."""
    more = [] if {"--resume", "--resume=auto", "--dry-run"} & {*arguments} else ["--resume", "auto"]
    return f"{program} {shlex.join([*arguments, *more])}"


def run(command: "Command", folder: Path, console: Console, started: float) -> None:
    """Train with evaluation before and after, export the adapters and write the report."""
    from lorasp_jax.evaluation.callback import Evaluation, NoEvaluation
    from lorasp_jax.report.callback import Report
    from lorasp_jax.training import loop, setup
    from lorasp_jax.training.distributed import processes
    from lorasp_jax.training.export import Export
    from lorasp_jax.training.weights_and_biases import WeightsAndBiases

    with contextlib.ExitStack() as stack:
        callbacks = []
        if command.wandb and processes.is_first():
            callbacks += [
                stack.enter_context(WeightsAndBiases(command.wandb, command.config, folder))
            ]
        prepared = setup.prepare(command.config, folder, console, started)
        evaluation = Evaluation() if prepared.simulated else NoEvaluation()
        callbacks = [Export(), evaluation, Report(), *callbacks]
        first = processes.is_first()
        loop.train(prepared, callbacks if first else [], resume=bool(command.resume))
    report = folder / "report.html"
    console.print(f"finished in {prepared.seconds['total']:.0f} s: {report}", markup=False)
