"""Dry run: parameter counts, memory and FLOPs of a run, from shapes alone."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
from flax import nnx
from rich.console import Console
from rich.table import Table

from lorasp_jax.adapters import adaptation
from lorasp_jax.base import hub
from lorasp_jax.config import Config
from lorasp_jax.dense import AdaptedLayer
from lorasp_jax.training import early, setup
from lorasp_jax.training.base import base_model
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.cost.preflight import HEADROOM, byte_unit, nbytes
from lorasp_jax.training.run import Run


def dry_run(
    config: Config, folder: Path, console: Console, load_base: setup.LoadBase = base_model
) -> None:
    """Build the run, compile its training step and print the cost, without writing to `folder`.

    A dataset cache in `folder` is used if present.

    Raises:
        ValueError: see `setup.build`.
    """
    built = setup.build(config, folder, abstract=True, load_base=load_base)
    remote = (config.model.source, config.model.tokenizer)
    if names := [name for name in remote if hub.is_remote(name)]:
        console.print(f"not downloaded for a dry run: {', '.join(names)}", soft_wrap=True)
    console.print(setup.headline(config, built.model))
    console.print(_parameter_table(built.model))
    run = Run(config, folder, console, built.base_hash)
    held, batches = early.data_shapes(run, built)
    compiled = early.compile_steps(run, built, batches)
    console.print(_memory_table(built, held, batches, compiled.memory_analysis()))
    step_flops = preflight.step_flops(config, built.base.config)
    console.print(
        f"one step of {config.optim.batch_size} windows: {step_flops / 1e12:.4g} TFLOP; "
        f"all {config.optim.steps} steps: {step_flops * config.optim.steps / 1e15:.4g} PFLOP"
    )
    console.print("dry run: nothing was collected, trained or written")


def _parameter_table(model: nnx.Module) -> Table:
    """Tabulate parameter counts per tower; layers outside the towers count as projections."""
    counts: dict[str, adaptation.Counts] = {}
    for name, child in vars(model).items():
        if isinstance(child, nnx.Module):
            part = "projections" if isinstance(child, AdaptedLayer) else name
            pair = adaptation.count(child), counts.get(part, adaptation.Counts(0, 0))
            counts[part] = adaptation.Counts(*map(sum, zip(*pair, strict=True)))
    table = _table("part", "parameters", "trainable", "share")
    for part, (trainable, total) in (counts | {"all": adaptation.count(model)}).items():
        table.add_row(part, f"{total:,}", f"{trainable:,}", f"{trainable / max(total, 1):.2%}")
    return table


def _memory_table(built: setup.RunSetup, held: int, batches: Any, analysis: Any) -> Table:
    """Tabulate the memory per device, as estimated and as compiled.

    `held` is the size of the dataset on every device [bytes], which is no argument of the compiled
    program; `batches` are the shapes of those that a call takes. `analysis` is the
    `memory_analysis` of the compiled step, or None if the backend does not provide it.
    """
    local = nbytes(batches) / len(jax.tree.leaves(batches)[0].sharding.device_set)
    estimate = {"demonstrations": held + local, **dataclasses.asdict(built.memory)}
    resident = ("base", "adapters", "optimizer", "demonstrations")
    arguments = sum(estimate[name] for name in resident)
    temporaries = sum(estimate[name] for name in estimate if name not in resident)
    headroom = built.memory.peak * (1 - 1 / HEADROOM)
    compiled: list[Any] = [None, None, None]
    if analysis is not None:
        inputs, temporary = analysis.argument_size_in_bytes + held, analysis.temp_size_in_bytes
        temporary += analysis.output_size_in_bytes - analysis.alias_size_in_bytes
        compiled = [inputs, temporary, inputs + temporary]
    peak = arguments + temporaries + headroom
    unit, name = byte_unit(max(peak, compiled[2] or 0))

    def add(part: str, *values: float | None) -> None:
        table.add_row(part, *("not reported" if v is None else f"{v / unit:.3f}" for v in values))

    title = f"{name} per device, {built.available / unit:,.0f} available"
    table = _table(title, "estimated", "compiled")
    for part in resident:
        add(f"  {part}", estimate[part])
    add("arguments", arguments, compiled[0])
    for part in ("gradients", "activations", "recomputation"):
        add(f"  {part}", estimate[part])
    add("  headroom", headroom)
    add("temporary", temporaries + headroom, compiled[1])
    add("peak", peak, compiled[2])
    return table


def _table(first: str, *numeric: str) -> Table:
    """Create an empty table with a text column followed by right-aligned numeric columns."""
    table = Table(first)
    for name in numeric:
        table.add_column(name, justify="right")
    return table
