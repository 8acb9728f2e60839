"""Dry run: parameter counts, memory and FLOPs of a run, from shapes alone."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console

from lorasp_jax.base import hub
from lorasp_jax.config import Config
from lorasp_jax.training import early, setup
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.cost.preflight import byte_unit
from lorasp_jax.training.dataset import is_simulated
from lorasp_jax.training.run import Run
from lorasp_jax.training.setup import RunSetup


def dry_run(config: Config, folder: Path, console: Console, budget: float | None = None) -> None:
    """Build the run, compile its training step and print the cost, without writing to `folder`.

    A dataset cache in `folder` is used if present. For `budget` see `setup.build`.

    Raises:
        ValueError: see `setup.build`.
    """
    built, held, compile_step = plan_step(config, folder, console, budget)
    compiled = compile_step()
    remote = (config.model.source, config.model.tokenizer)
    if names := [name for name in remote if hub.is_remote(name)]:
        console.print(f"not downloaded for a dry run: {', '.join(names)}", soft_wrap=True)
    console.print(setup.headline(config, built.model))
    console.print(f"memory per device, estimated: {built.memory}", soft_wrap=True)
    if planned := planned_bytes(compiled):
        parts = {"dataset": held, **planned}
        unit, name = byte_unit(peak := sum(parts.values()))
        listed = ", ".join(f"{part} {value / unit:.2f}" for part, value in parts.items())
        text = f"memory per device, compiled: {listed}, peak {peak / unit:.2f} {name}"
        console.print(text, soft_wrap=True)
    unit, name = byte_unit(built.available)
    console.print(f"memory per device, available: {built.available / unit:,.0f} {name}")
    step_flops = preflight.step_flops(config, built.base.config)
    console.print(
        f"one step of {config.optim.batch_size} windows: {step_flops / 1e12:.4g} TFLOP; "
        f"all {config.optim.steps} steps: {step_flops * config.optim.steps / 1e15:.4g} PFLOP"
    )
    console.print("dry run: nothing was collected, trained or written")


def plan_step(
    config: Config, folder: Path, console: Console, budget: float | None = None
) -> tuple[RunSetup, int, Callable[[], Any]]:
    """Prepare the training step of a run from shapes alone, without writing to `folder`.

    Returns:
        The run's setup, the bytes of the dataset on every device, which is no argument of the
        program, and a function that compiles the program.

    Raises:
        ValueError: see `setup.build`.
    """
    built = setup.build(config, folder, abstract=True, budget=budget)
    run = Run(config, folder, console, built.base_hash)
    if built.source:
        first = built.source.episode(0, ())
        run.simulated = is_simulated([first.task], first.robot, first.physics_dt)
    held, batches = early.data_shapes(run, built)
    return built, held, functools.partial(early.compile_steps, run, built, batches)


def planned_bytes(compiled: Any) -> dict[str, int]:
    """Return the memory that XLA plans for a program on each device; empty if it does not tell."""
    if (analysis := compiled.memory_analysis()) is None:
        return {}
    temporary = analysis.temp_size_in_bytes
    temporary += analysis.output_size_in_bytes - analysis.alias_size_in_bytes
    return {"arguments": analysis.argument_size_in_bytes, "temporary": temporary}
