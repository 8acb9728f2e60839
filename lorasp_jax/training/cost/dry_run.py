"""What a run will need, from shapes alone: sizes, memory, work of a step."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from rich.console import Console
from rich.table import Table

from envs.compilation import fast_cpu, messages
from envs.datasets.episodes import Episodes
from lorasp_jax.adapters import adaptation
from lorasp_jax.config import Config
from lorasp_jax.data.batches import Raw, Steps, flatten, gather
from lorasp_jax.dense import AdaptedLayer
from lorasp_jax.policies.policy import Policy
from lorasp_jax.storage import hub
from lorasp_jax.training import loop, setup
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.cost.preflight import HEADROOM, unit_of
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.optim import make_optimizer
from lorasp_jax.training.run import Run
from lorasp_jax.training.step import init_state


def dry_run(config: Config, folder: Path, console: Console) -> None:
    """Build the run, compile its training step and print what both need; writes nothing.

    Args:
        config: of the run.
        folder: the run's; read for the cache of its dataset, if that is there.
        console: where to print.

    Raises:
        ValueError: as `setup.build`.
    """
    built = setup.build(config, folder, shapes=True)
    remote = (config.model.source, config.model.tokenizer)
    if names := [name for name in remote if hub.is_remote(name)]:
        console.print(f"not downloaded, its shapes suffice: {', '.join(names)}", soft_wrap=True)
    console.print(setup.headline(config, built.model))
    console.print(_parameters(built.model))
    run = Run(config, folder, console, built.base_hash)
    data = _prepared(run, built)
    with messages.announced("the training step"):
        options = fast_cpu.without_simulation()
        compiled = _lowered(run, data).compile(compiler_options=options)
    console.print(_memory(built, _bytes(data) / _split(data), compiled.memory_analysis()))
    operations = preflight.operations(config, built.base.config)
    console.print(
        f"a step of {config.optim.batch_size} windows: {operations / 1e12:.4g} TFLOP; "
        f"all {config.optim.steps} steps: {operations * config.optim.steps / 1e15:.4g} PFLOP"
    )
    console.print("dry run: nothing was collected, trained or written")


def _prepared(run: Run, built: setup.Built) -> Any:
    """Shapes of what a step is given, `Steps` or `Raw`; the run gets its policy.

    Statistics are those of one episode; of the expert, which has not begun, all steps are zero, and
    there are as many as the tasks' time limits allow.
    """
    config, source = run.config, built.source
    first = source.episode(0) if source else _blank(config, built)
    limits = sum(world.max_steps for world in built.worlds)
    count = source.num_steps if source else config.data.episodes * limits
    model = built.base.config
    relative = config.model.relative_actions
    run.policy = Policy(
        built.model, setup.processor([first], model, built.prompts, relative=relative)
    )
    mesh = meshes.make_mesh(config.fsdp, run.devices)
    one = jax.eval_shape(lambda: flatten([first]))
    steps = jax.tree.map(lambda x: jax.ShapeDtypeStruct((count, *x.shape[1:]), x.dtype), one)
    if source is None or _bytes(steps) <= built.room:
        return _placed(steps, meshes.replicated(mesh))
    starts = jax.ShapeDtypeStruct((config.optim.batch_size,), jnp.int32)
    raw = jax.eval_shape(functools.partial(gather, chunk=model.chunk), steps, starts)
    return _placed(raw, meshes.batch_sharding(mesh))


def _blank(config: Config, built: setup.Built) -> Episodes:
    """One step of the first task, all zeros."""
    world, size = built.worlds[0], config.image_size
    numbers = np.zeros((1, 1, built.joints + 1), np.float32)
    return Episodes(
        image={name: np.zeros((1, 1, size, size, 3), np.uint8) for name in world.cameras},
        state=numbers,
        action=numbers,
        length=np.ones(1, np.int32),
        instruction=np.zeros(1, np.int32),
        instructions=tuple(built.prompts.instructions),
        task=config.tasks[0],
        robot=config.robot,
        control_dt=config.control_dt,
        physics_dt=0.0,
        attempted=1,
    )


def _lowered(run: Run, data: Steps | Raw) -> Any:
    """The steps that `loop.train` compiles first, from shapes."""
    config, model = run.config, run.policy.model
    optimizer = make_optimizer(config.optim, adaptation.methods(model).values())
    mesh = meshes.make_mesh(config.fsdp, run.devices)
    graphdef, adapters, frozen = adaptation.split(model)
    state = jax.eval_shape(
        functools.partial(init_state, optimizer=optimizer, ema=config.optim.ema > 0), adapters
    )
    placed = meshes.shardings(state, mesh)
    frozen = jax.tree.map(_placed, frozen, meshes.shardings(frozen, mesh))
    state = jax.tree.map(_placed, state, placed)
    count = 1 if isinstance(data, Raw) else min(config.log_every, config.optim.steps)
    steps = loop.jit_steps(run, graphdef, optimizer, placed)
    return steps.lower(frozen, data, state, jax.random.key(0), count)


def _placed(tree: Any, sharding: jax.sharding.Sharding) -> Any:
    """Shapes of arrays, and where they lie."""
    place = lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding)  # noqa: E731
    return jax.tree.map(place, tree)


def _split(data: Steps | Raw) -> int:
    """Devices that share the data."""
    return jax.device_count() if isinstance(data, Raw) else 1


def _bytes(shapes: Any) -> float:
    return float(sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(shapes)))


def _parameters(model: nnx.Module) -> Table:
    """Numbers of parameters by tower; the layers around the towers are its projections."""
    counts: dict[str, adaptation.Counts] = {}
    for name, child in vars(model).items():
        if isinstance(child, nnx.Module):
            part = "projections" if isinstance(child, AdaptedLayer) else name
            more, before = adaptation.count(child), counts.get(part, adaptation.Counts(0, 0))
            counts[part] = adaptation.Counts(*map(sum, zip(more, before, strict=True)))
    table = _table("part", "parameters", "that train", "share")
    for part, (trainable, total) in (counts | {"all": adaptation.count(model)}).items():
        table.add_row(part, f"{total:,}", f"{trainable:,}", f"{trainable / max(total, 1):.2%}")
    return table


def _memory(built: setup.Built, data: float, program: Any) -> Table:
    """What was expected beside what the compiled program takes, by device.

    Args:
        built: what was expected.
        data: bytes of demonstrations, or of a streamed batch.
        program: `memory_analysis` of the compiled step; None where a backend has none.
    """
    expected = {"demonstrations": data, **dataclasses.asdict(built.memory)}
    kept = ("base", "adapters", "optimizer", "demonstrations")
    arguments = sum(expected[name] for name in kept)
    temporaries = sum(expected[name] for name in expected if name not in kept)
    headroom = built.memory.peak * (1 - 1 / HEADROOM)
    found: list[Any] = [None, None, None]
    if program is not None:
        takes, needs = program.argument_size_in_bytes, program.temp_size_in_bytes
        more = program.output_size_in_bytes - program.alias_size_in_bytes
        found = [takes, needs + more, takes + needs + more]
    peak = arguments + temporaries + headroom
    unit, name = unit_of(max(peak, found[2] or 0))

    def add(part: str, *values: float | None) -> None:
        table.add_row(part, *("not reported" if v is None else f"{v / unit:.3f}" for v in values))

    table = _table(f"{name} of {built.available / unit:,.0f} a device", "expected", "compiled")
    for part in kept:
        add(f"  {part}", expected[part])
    add("arguments", arguments, found[0])
    for part in ("gradients", "activations"):
        add(f"  {part}", expected[part])
    add("  headroom", headroom)
    add("temporary", temporaries + headroom, found[1])
    add("peak", peak, found[2])
    return table


def _table(first: str, *numbers: str) -> Table:
    """An empty table whose columns but the first hold numbers."""
    table = Table(first)
    for name in numbers:
        table.add_column(name, justify="right")
    return table
