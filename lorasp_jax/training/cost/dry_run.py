"""Dry run: parameter counts, memory and FLOPs of a run, from shapes alone."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx
from rich.console import Console
from rich.table import Table

from envs.compilation import fast_cpu, messages
from envs.datasets.episodes import Episodes
from lorasp_jax.adapters import adaptation
from lorasp_jax.config import Config
from lorasp_jax.data.batches import flatten
from lorasp_jax.dense import AdaptedLayer
from lorasp_jax.policies.policy import Policy
from lorasp_jax.storage import hub
from lorasp_jax.training import loop, setup
from lorasp_jax.training.base import base_model
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.cost.preflight import HEADROOM, byte_unit, nbytes
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.optim import make_optimizer
from lorasp_jax.training.run import Run
from lorasp_jax.training.step import init_state
from lorasp_jax.training.windows import DrawnWindows


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
    held, batches = _abstract_data(run, built)
    with messages.announce("the training step"):
        options = fast_cpu.without_simulation()
        compiled = _lower(run, batches).compile(compiler_options=options)
    console.print(_memory_table(built, held, batches, compiled.memory_analysis()))
    step_flops = preflight.step_flops(config, built.base.config)
    console.print(
        f"one step of {config.optim.batch_size} windows: {step_flops / 1e12:.4g} TFLOP; "
        f"all {config.optim.steps} steps: {step_flops * config.optim.steps / 1e15:.4g} PFLOP"
    )
    console.print("dry run: nothing was collected, trained or written")


def _abstract_data(run: Run, built: setup.RunSetup) -> tuple[int, Any]:
    """Set `run.policy`, and return the bytes of the dataset and the shapes of a call's batches.

    A streamed dataset has 0 bytes on the device. Statistics come from the dataset's first episode.
    Without a dataset, they come from a blank step, and all demonstrations are assumed to have the
    maximum length.
    """
    config, source = run.config, built.source
    first = source.episode(0) if source else _blank_episode(config, built)
    limits = sum(env.max_steps for env in built.environments)
    count = source.num_steps if source else config.data.episodes * limits
    model = built.base.config
    relative = config.model.relative_actions
    run.policy = Policy(
        built.model, setup.processor([first], model, built.prompts, relative=relative)
    )
    mesh, size = meshes.make_mesh(config.fsdp, run.devices), config.optim.batch_size
    episode = jax.eval_shape(lambda: flatten([first]))
    steps = jax.tree.map(lambda x: jax.ShapeDtypeStruct((count, *x.shape[1:]), x.dtype), episode)
    windows = DrawnWindows(steps, mesh, size, model.chunk)
    if source is None or nbytes(steps) <= built.free_bytes:
        call_size = windows.call_size(min(config.log_every, config.optim.steps))
        return nbytes(steps), windows.shapes(call_size)
    return 0, windows.shapes(1)


def _blank_episode(config: Config, built: setup.RunSetup) -> Episodes:
    """Return an episode of the first task with a single step, all zeros."""
    env, size = built.environments[0], config.image_size
    zeros = np.zeros((1, 1, built.joints + 1), np.float32)
    return Episodes(
        image={name: np.zeros((1, 1, size, size, 3), np.uint8) for name in env.cameras},
        state=zeros,
        action=zeros,
        length=np.ones(1, np.int32),
        instruction=np.zeros(1, np.int32),
        instructions=tuple(built.prompts.instructions),
        task=config.tasks[0],
        robot=config.robot,
        control_dt=config.control_dt,
        physics_dt=0.0,
        attempted=1,
    )


def _lower(run: Run, batches: Any) -> Any:
    """Lower the steps that `loop.train` compiles first, from shapes alone."""
    config, model = run.config, run.policy.model
    optimizer = make_optimizer(config.optim, adaptation.methods(model).values())
    mesh = meshes.make_mesh(config.fsdp, run.devices)
    graphdef, adapters, frozen = adaptation.split(model)
    state = jax.eval_shape(
        functools.partial(init_state, optimizer=optimizer, ema=config.optim.ema > 0), adapters
    )
    shardings = meshes.shardings(state, mesh)
    frozen = loop.Frozen(frozen, run.policy.processor.shared())
    frozen = jax.tree.map(_with_sharding, frozen, meshes.shardings(frozen, mesh))
    state = jax.tree.map(_with_sharding, state, shardings)
    steps = loop.jit_steps(run, graphdef, optimizer, shardings)
    return steps.lower(frozen, batches, state, jax.random.key(0))


def _with_sharding(tree: Any, sharding: jax.sharding.Sharding) -> Any:
    """Attach a sharding to the shapes of a tree."""
    shape = lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding)  # noqa: E731
    return jax.tree.map(shape, tree)


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
    for part in ("gradients", "activations"):
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
