"""From a config to a run that is ready to train: base, adapters, demonstrations, processor."""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from rich.console import Console
from rich.progress import TaskID

import envs
from envs.env import Env
from envs.episodes import Episodes
from lorasp_jax import adaptation, calibration, models, peft, tables
from lorasp_jax.config import Config
from lorasp_jax.data.batches import Batch, encode, flatten, sample_batch, windows
from lorasp_jax.data.demonstrations import demonstrations
from lorasp_jax.data.imported import cached, is_simulated, opened, outline
from lorasp_jax.data.source import Source
from lorasp_jax.data.stream import Stream
from lorasp_jax.models import backbone, loading, places, presets, tokenizer
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.policy import Policy
from lorasp_jax.models.processing import Processor, Statistics, check_delta, robot_slots, to_delta
from lorasp_jax.models.prompt_table import PromptTable
from lorasp_jax.training import preflight
from lorasp_jax.training.loop import Run
from lorasp_jax.training.progress import bars

STATISTICS_BATCHES = 8
"""Batches that an initialization from data looks at."""
SIZES = ("nano", "small", "base", "nano_pi05", "base_pi05")
TRAINING = "training.json"
"""File beside base weights: what they were trained on, with the control period."""


def prepare(config: Config, folder: Path, console: Console, started: float) -> Run:
    """Load or create the base, attach the adapters, get the demonstrations.

    What can be wrong with a config is found before anything long begins.

    Raises:
        ValueError: an unknown task, robot, backbone or size, a base or a tokenizer that does not
            fit, a rule that matches nothing, a chunk or batch that does not fit.
    """
    sizes = {"image_size": config.image_size, "control_dt": config.control_dt}
    tasks = () if config.data.source else config.tasks
    worlds = [envs.make(task, robot=config.robot, **sizes) for task in tasks]
    words = tokenizer.load(config.model.tokenizer)
    base, base_hash = base_model(config)
    base = _changed(base, max_tokens=config.model.max_tokens or base.config.max_tokens)
    source = opened(config, base.config, folder) if config.data.source else None
    prompts, joints = _told(source, worlds, words, base.config)
    _check_sizes(config, base.config.chunk)
    check_delta(base.config.inputs.delta, joints)
    available = preflight.available_bytes()
    remat, memory = preflight.choose_remat(config, base.config, available)
    base = _changed(base, remat=remat)
    model = _adapted(config, base, config.peft.as_saved)
    console.print(
        f"scale {config.scale}: {type(config.peft).__name__} on {config.model.backbone} "
        f"{config.model.size}, {tables.trained_share(model)}"
    )
    console.print(f"memory by device in GiB: {memory}; rematerialisation: {remat}")
    run = Run(config, folder, console, base_hash, started)
    with run.timed("collect"):
        if source:
            _import(run, source, available - memory.peak)
        else:
            run.episodes = _collect(run, prompts.instructions)
    relative = config.model.relative_actions
    found = processor([*run.episodes.values()], model.config, prompts, relative=relative)
    if config.peft.needs_statistics:
        statistics = input_moments(run, base, found)
        model = _adapted(config, base, config.peft, statistics)
    run.policy = Policy(model, found)
    return run


def _told(
    source: Source | None, worlds: Sequence[Env], words: tokenizer.Tokenizer, model: BackboneConfig
) -> tuple[PromptTable, int]:
    """Prompts of a dataset's or the simulated tasks' instructions, and the robot's joints J."""
    if source is None:
        joints = worlds[0].robot.num_joints
        instructions = [phrase for env in worlds for phrase in env.instructions]
        return PromptTable.of(words, instructions, model, num_joints=joints), joints
    first = source.episode(0, ())
    joints = first.state.shape[-1] - 1
    try:
        prompts = PromptTable.of(words, first.instructions, model, num_joints=joints)
    except ValueError as error:
        fields = "--model.tokenizer or --model.max-tokens"
        raise ValueError(f"the dataset does not fit {fields}: {error}") from error
    return prompts, joints


def _check_sizes(config: Config, chunk: int) -> None:
    """Raise ValueError unless chunk and batch fit."""
    if config.evaluation.execute_steps > chunk:
        raise ValueError(
            f"execute_steps must be 1 to the chunk, {chunk}, got {config.evaluation.execute_steps}"
        )
    if config.optim.batch_size % jax.device_count():
        raise ValueError(
            f"batch_size must be a multiple of the {jax.device_count()} devices, "
            f"got {config.optim.batch_size}"
        )


def _adapted(
    config: Config,
    model: Backbone,
    method: peft.Method,
    statistics: Mapping[str, jax.Array] = MappingProxyType({}),
) -> Backbone:
    """The model with the method on the run's targets, from the run's key."""
    rngs = nnx.Rngs(jax.random.fold_in(jax.random.key(config.seed), 3))
    rules = presets.rules(config.targets, method)
    return adaptation.adapt(model, rules, rngs=rngs, statistics=statistics)


def input_moments(run: Run, model: Backbone, processor: Processor) -> dict[str, jax.Array]:
    """`calibration.input_moments` of the run's targets, over batches as training draws them."""
    config, draw = run.config, _drawing(run, processor, model.config.chunk)

    def forward(model: Backbone, drawn: tuple[jax.Array, Batch]) -> Any:
        key, batch = drawn
        return model.loss(key, batch.observation, batch.actions, action_mask=batch.action_mask)

    keys = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), 5), STATISTICS_BATCHES)
    pattern = "|".join(f"(?:{path})" for path in presets.patterns(config.targets))
    batches = ((key, draw(key)) for key in keys)
    return calibration.input_moments(model, batches, pattern, forward)


def _drawing(run: Run, processor: Processor, chunk: int) -> Callable[[jax.Array], Batch]:
    """What gives a batch for a key, of a run that is not yet trained."""
    size, noise = run.config.optim.batch_size, run.config.optim.state_noise
    if run.streams:
        stream = Stream(run.steps, batch_size=size, chunk=chunk, seed=run.config.seed)
        return lambda key: encode(key, next(stream), processor, state_noise=noise)
    steps = jax.device_put(run.steps)
    return jax.jit(
        lambda key: sample_batch(
            key, steps, processor, batch_size=size, chunk=chunk, state_noise=noise
        )
    )


def base_model(config: Config) -> tuple[Backbone, str]:
    """The frozen base and its hash: loaded from the checkpoint, or random where none is named.

    Raises:
        ValueError: an unknown backbone or size, or a base of another one.
    """
    chosen, kind = config.model, backbone.find(config.model.backbone)
    sizes = [size for size in SIZES if hasattr(kind, size)]
    if chosen.size not in sizes:
        raise ValueError(f"unknown size {chosen.size!r}: it is one of {', '.join(sizes)}")
    wanted: BackboneConfig = getattr(kind, chosen.size)()
    unroll = wanted.unroll if chosen.unroll is None else chosen.unroll
    kinds = {"dtype": chosen.dtype, "param_dtype": chosen.param_dtype, "unroll": unroll}
    wanted = dataclasses.replace(wanted, **kinds)
    if not wanted.inputs.masks_missing:
        wanted = dataclasses.replace(wanted, cameras=wanted.cameras[: len(envs.Env.cameras)])
    if chosen.source:
        folder = places.local(chosen.source)
        inputs = loading.lerobot_inputs(folder) or wanted.inputs
        wanted = dataclasses.replace(wanted, inputs=inputs)
        model = models.load(folder, wanted)
        if loading.is_own(folder):
            _check_time(folder, config.control_dt)
        return model, models.weights_hash(model)
    key = jax.random.fold_in(jax.random.key(config.seed), 4)
    model = wanted.create(nnx.Rngs(key))
    return model, models.weights_hash(model)


def _changed(model: Backbone, **changes: Any) -> Backbone:
    """The same parameters in a model whose config differs in what no parameter depends on."""
    wanted = dataclasses.replace(model.config, **changes)
    if wanted == model.config:
        return model
    abstract = nnx.eval_shape(lambda: wanted.create(nnx.Rngs(0)))
    return nnx.merge(nnx.graphdef(abstract), nnx.state(model))


def _check_time(folder: Path, control_dt: float) -> None:
    """Raise ValueError unless the base in a folder was trained at this control period."""
    path = folder / TRAINING
    try:
        found = json.loads(path.read_text())["control_dt"]
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(f"{path} does not say the control_dt that the base needs") from error
    if found != control_dt:
        raise ValueError(
            f"{folder} was trained with control_dt {found} s, this run has {control_dt}"
        )


def processor(
    episodes: Sequence[Episodes],
    model_config: BackboneConfig,
    prompts: PromptTable,
    *,
    relative: bool = False,
) -> Processor:
    """Statistics of the demonstrations, with the prompts of all their instructions, in order.

    The robot's cameras take the backbone's places in turn; there may be more places than cameras.

    Args:
        episodes: by task.
        model_config: sizes and inputs.
        prompts: of the instructions, task after task.
        relative: joint targets are learned relative to the state that a chunk starts from; else
            what the model's config says is.
    """
    joints = episodes[0].state.shape[-1] - 1
    slots, dim = robot_slots(joints, model_config.inputs), model_config.action_dim
    delta = (*[True] * joints, False) if relative else model_config.inputs.delta
    steps = flatten([dataclasses.replace(group, image={}) for group in episodes])
    chunk = model_config.chunk if delta else 1
    window, _ = windows(steps, jnp.arange(len(steps.end)), chunk)
    action = np.asarray(
        to_delta(jnp.asarray(steps.action[window]), jnp.asarray(steps.state), delta)
    ).reshape(-1, joints + 1)
    state = np.repeat(np.asarray(steps.state), chunk, axis=0)
    everything = np.ones(len(state), bool)
    statistics = Statistics.measure(state, action, everything, slots=slots, dim=dim)
    cameras = dict(zip(model_config.cameras, sorted(episodes[0].image), strict=False))
    return Processor.of(
        model_config, statistics, prompts, num_joints=joints, cameras=cameras, delta=delta
    )


def _import(run: Run, source: Source, room: float) -> None:
    """Give the run its dataset, with a bar; it streams where it needs more than `room` bytes."""
    with bars(run.console, "steps") as progress:
        bar = progress.add_task(f"reading {run.config.data.source}", total=None)
        report = lambda done, total: progress.update(bar, completed=done, total=total)  # noqa: E731
        found = cached(source, run.folder, report)
        progress.update(bar, completed=found.num_steps, total=found.num_steps)
    facts = found.facts
    run.dataset, run.episodes, run.simulated = found.steps, outline(found), is_simulated(found)
    run.streams = sum(x.nbytes for x in jax.tree.leaves(run.dataset)) > room
    run.config = dataclasses.replace(run.config, robot=facts["robot"], tasks=tuple(facts["tasks"]))
    place = "in files" if run.streams else "on the device"
    run.console.print(f"{found.num_steps} steps of {len(found)} episodes, {place}")


def _collect(run: Run, instructions: Sequence[str]) -> dict[str, Episodes]:
    """Demonstrations by task, with a bar each; they index the instructions."""
    with bars(run.console, "episodes") as progress:
        started: dict[str, TaskID] = {}

        def report(task: str, done: int, total: int) -> None:
            text = f"collecting {task}" if done else f"compiling the expert of {task} ..."
            if task not in started:
                started[task] = progress.add_task(text, total=total)
            progress.update(started[task], completed=done, description=text)

        found = demonstrations(run.config, run.folder, report)
    if [phrase for group in found.values() for phrase in group.instructions] != [*instructions]:
        raise ValueError(f"{run.folder} holds demonstrations of other instructions; start anew")
    return found
