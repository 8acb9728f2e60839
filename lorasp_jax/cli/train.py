"""Adapt a policy to a robot: `lorasp-jax train`, or `python train.py` in a checkout."""

import contextlib
import dataclasses
import os
import shlex
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from lorasp_jax.base import compilation_cache as cache
from lorasp_jax.base.errors import run_command

if TYPE_CHECKING:
    from lorasp_jax.config import Config
    from lorasp_jax.training.overrides import Command

RUNS = Path("runs")


def main(arguments: Sequence[str], program: str = "python train.py") -> int:
    """Run one experiment; return the exit code.

    0: success; 2: invalid input or a run that cannot continue; 130: stopped by a signal.
    """
    started = time.perf_counter()
    if any(text.partition("=")[0] == "--fit" for text in arguments):
        # JAX leaves a quarter of the GPU to others unless told otherwise before it starts.
        os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", "0.95")
    import flax
    import jax

    import lorasp_jax
    from lorasp_jax.training.distributed import processes
    from lorasp_jax.training.interrupt import sigterm_as_interrupt
    from lorasp_jax.training.overrides import parse
    from lorasp_jax.training.run_folder import to_json

    console, errors = Console(), Console(stderr=True)
    resume = resume_command(arguments, program)

    def adapt() -> None:
        cache.enable()
        with sigterm_as_interrupt():
            if "--distributed" in arguments:
                processes.initialize(console)
                console.quiet = not processes.is_first()
                versions = {x.__name__: x.__version__ for x in (jax, flax, lorasp_jax)}
                processes.agree("versions", versions)
            with processes.together():
                command = _resolved(_with_plan(parse(arguments, program)))
            options = {"resume": command.resume, "dry_run": command.dry_run}
            processes.agree("settings", to_json(command.config) | options)
            _execute(command, console, started)

    remedy = ": free some memory or disk space and add --resume"
    return run_command(adapt, errors, f"stopped; to resume: {resume}", remedy)


def _with_plan(command: "Command") -> "Command":
    """Resume a run with its own plan of ranks, whose file need not exist any more."""
    from lorasp_jax.training import finished_run, records, run_folder

    config = command.config
    if not command.resume or config.plan or _kind(config):
        return command
    path = RUNS / config.name / run_folder.CONFIG_FILE
    plan = finished_run.recorded_plan(run_folder.read_json(path, records.CONFIG))
    return dataclasses.replace(command, config=dataclasses.replace(config, plan=plan))


def _resolved(command: "Command") -> "Command":
    """Complete the config of a run that starts from another by what that decides."""
    if not (kind := _kind(command.config)):
        return command
    import jax

    others = {"dry_run": command.dry_run, "fit": command.fit, "wandb": command.wandb}
    others["protect"] = bool(command.config.protect)
    others["distributed"] = jax.distributed.is_initialized()
    for name in (name for name, value in others.items() if value):
        raise ValueError(f"--{name.replace('_', '-')} is not for {kind.KIND}: drop it")
    config = kind.resolve(command.config, command.given)
    return dataclasses.replace(command, config=config)


def _kind(config: "Config") -> Any:
    """Return the command of a run that starts from another, None for other runs."""
    from lorasp_jax.distill_flow.config import DistillFlowConfig
    from lorasp_jax.reinforce.config import ReinforceConfig

    if isinstance(config, ReinforceConfig):
        from lorasp_jax.reinforce import command as reinforce

        return reinforce
    if isinstance(config, DistillFlowConfig):
        from lorasp_jax.distill_flow import command as distill_flow

        return distill_flow
    return None


def _execute(command: "Command", console: Console, started: float) -> None:
    """Do a dry run, train, or rebuild the report of a finished run."""
    from lorasp_jax.training.distributed import processes
    from lorasp_jax.training.run_folder import open_run

    folder, budget = RUNS / command.config.name, None
    if command.fit:
        from lorasp_jax.training.cost import fit

        config = fit.resumed(command.config, command.given, folder) if command.resume else None
        chosen = config or fit.fitted(command.config, command.fit, command.given, folder, console)
        command, budget = dataclasses.replace(command, config=chosen), fit.budget(command.fit)
    if command.dry_run:
        from lorasp_jax.training.cost.dry_run import dry_run

        dry_run(command.config, folder, console, budget)
        return
    with contextlib.ExitStack() as stack:
        with processes.together():
            if processes.is_first():
                stack.enter_context(open_run(command.config, RUNS, resume=command.resume))
        if not (command.resume and (folder / "results.json").exists()):
            run(command, folder, console, started, budget)
        elif processes.is_first():
            from lorasp_jax.report.html import write_report

            report = write_report(folder)
            console.print(f"this run has already finished: see {report}", markup=False)


def resume_command(arguments: Sequence[str], program: str) -> str:
    """Return the command that resumes this run, or starts it if it has not started yet."""
    has_mode = {"--resume", "--resume=auto", "--dry-run"} & {*arguments}
    mode = [] if has_mode else ["--resume", "auto"]
    return f"{program} {shlex.join([*arguments, *mode])}"


def run(
    command: "Command", folder: Path, console: Console, started: float, budget: float | None = None
) -> None:
    """Evaluate, train, evaluate again, export the policy and write the report.

    For `budget` see `setup.build`.
    """
    import jax

    if kind := _kind(command.config):
        kind.run(command.config, folder, console, started, resume=bool(command.resume))
        return

    from lorasp_jax.evaluation.callback import Evaluation, NoEvaluation
    from lorasp_jax.evaluation.validation import Validation
    from lorasp_jax.report.callback import Report
    from lorasp_jax.training import early, loop, setup
    from lorasp_jax.training.distributed import processes
    from lorasp_jax.training.export import Export
    from lorasp_jax.training.weights_and_biases import WeightsAndBiases

    with contextlib.ExitStack() as stack:
        callbacks = []
        if command.wandb and processes.is_first():
            callbacks += [
                stack.enter_context(WeightsAndBiases(command.wandb, command.config, folder))
            ]
        evaluation = Evaluation()
        several = jax.process_count() > 1  # they compile together, and one collects first
        meanwhile = () if several else (early.compile_training, evaluation.compile_early)
        options: Any = {"meanwhile": meanwhile, "budget": budget}
        training_run = setup.prepare(command.config, folder, console, started, **options)
        judge = evaluation if training_run.simulated else NoEvaluation()
        callbacks = [Validation(), Export(), judge, Report(), *callbacks]
        first = processes.is_first()
        loop.train(training_run, callbacks if first else [], resume=bool(command.resume))
    processes.barrier("ended")  # after uploads, which may take longer than JAX waits at exit
    report = folder / "report.html"
    console.print(f"finished in {training_run.seconds['total']:.0f} s: {report}", markup=False)
