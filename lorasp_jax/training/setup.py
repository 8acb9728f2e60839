"""From a config to a run that is ready to train: base, adapters, demonstrations, processor."""

import dataclasses
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
from envs.cli.bars import bars
from envs.datasets.episodes import Episodes
from envs.env import Env
from lorasp_jax import peft
from lorasp_jax.adapters import adaptation, summary
from lorasp_jax.adapters.compress import calibration
from lorasp_jax.config import Config
from lorasp_jax.data.batches import Batch, encode, flatten, sample_batch, windows
from lorasp_jax.data.checked_images import load_images
from lorasp_jax.data.source import Source
from lorasp_jax.data.stream import Stream
from lorasp_jax.models import presets
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.policies import tokenizer
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor, Statistics, check_delta, robot_slots, to_delta
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.storage import hub
from lorasp_jax.training.base import base_model, changed
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.dataset import cached, is_simulated, opened, outline
from lorasp_jax.training.demonstrations import demonstrations
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.distributed import processes
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run import Run
from lorasp_jax.training.run_folder import record_dataset

STATISTICS_BATCHES = 8
"""Batches that an initialization from data looks at."""


@dataclasses.dataclass(frozen=True)
class Built:
    """A run before it has demonstrations.

    Attributes:
        base: the frozen base, with the rematerialisation that was chosen.
        base_hash: its hash.
        model: the base with adapters; of a method that starts from data, as they are saved.
        prompts: of all instructions.
        joints: J of the robot.
        worlds: an environment a task; none with a dataset.
        source: the dataset; None: the expert.
        memory: what a step is expected to need.
        available: bytes of memory that a device has.
    """

    base: Backbone
    base_hash: str
    model: Backbone
    prompts: PromptTable
    joints: int
    worlds: Sequence[Env]
    source: Source | None
    memory: preflight.Memory
    available: float

    @property
    def room(self) -> float:
        """Bytes of a device that a step leaves."""
        return self.available - self.memory.peak


def build(config: Config, folder: Path, *, shapes: bool = False) -> Built:
    """Load or create the base and attach the adapters; writes nothing.

    What can be wrong with a config is found here, before anything long begins.

    Args:
        config: of the run.
        folder: the run's.
        shapes: for a look at it: the model is abstract, and nothing is downloaded; the offline
            tokenizer stands for another one.

    Raises:
        ValueError: an unknown task, robot, backbone or size, a base or a tokenizer that does not
            fit, a rule that matches nothing, a chunk or batch that does not fit.
    """
    sizes = {"image_size": config.image_size, "control_dt": config.control_dt}
    tasks = () if config.data.source else config.tasks
    worlds = [envs.make(task, robot=config.robot, **sizes) for task in tasks]
    stands_in = shapes and hub.is_remote(config.model.tokenizer)
    words = tokenizer.load_tokenizer("" if stands_in else config.model.tokenizer)
    base, base_hash = base_model(config, shapes=shapes)
    base = changed(base, max_tokens=config.model.max_tokens or base.config.max_tokens)
    source = opened(config, base.config, folder) if config.data.source else None
    prompts, joints = _told(source, worlds, words, base.config)
    _check_sizes(config, base.config.chunk)
    check_delta(base.config.inputs.delta, joints)
    robot_slots(joints, base.config.inputs)
    available = preflight.available_bytes()
    remat, memory = preflight.choose_remat(config, base.config, available)
    base = changed(base, remat=remat)
    model = (
        preflight.abstract_model(config, base.config)
        if shapes
        else _adapted(config, base, config.peft.as_saved)
    )
    return Built(base, base_hash, model, prompts, joints, worlds, source, memory, available)


def prepare(config: Config, folder: Path, console: Console, started: float) -> Run:
    """`build`, then get the demonstrations.

    Raises:
        ValueError: as `build`; a dataset or the expert that fails.
    """
    built = build(config, folder)
    base, model = built.base, built.model
    processes.agree("base models", {"base": built.base_hash, "remat": base.config.remat})
    console.print(headline(config, model))
    console.print(f"memory by device: {built.memory}; rematerialisation: {base.config.remat}")
    run = Run(config, folder, console, built.base_hash, started)
    with run.timed("collect"), processes.first_process_first("collected"):
        if built.source:
            _import(run, built.source, built.room)
        else:
            run.episodes = _collect(run, built.prompts.instructions)
    run.streams = processes.any_process(run.streams)  # all or none: they share every batch
    relative = config.model.relative_actions
    found = processor([*run.episodes.values()], model.config, built.prompts, relative=relative)
    if config.peft.needs_statistics:
        statistics = input_moments(run, base, found)
        model = _adapted(config, base, config.peft, statistics)
    if built.source:
        console.print(_seen(run, found), markup=False, soft_wrap=True)
    run.policy = Policy(model, found)
    return run


def headline(config: Config, model: Backbone) -> str:
    """One line: scale, method, backbone and what trains."""
    return (
        f"scale {config.scale}: {type(config.peft).__name__} on {config.model.backbone} "
        f"{config.model.size}, {summary.trained_share(model)}"
    )


def _seen(run: Run, processor: Processor) -> str:
    """One line: which of a dataset's cameras takes which of the backbone's places."""
    pictures = next(iter(run.episodes.values())).image
    taken = [
        f"{name} ({pictures[name].shape[3]} x {pictures[name].shape[2]}) as {place}"
        for place, name in processor.cameras
        if name
    ]
    size = processor.image_size
    return f"cameras: {', '.join(taken)}; the backbone sees {size} x {size}"


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
    """Raise ValueError unless chunk, batch and devices fit."""
    meshes.make_mesh(config.fsdp)
    if config.evaluation.execute_steps > chunk:
        raise ValueError(
            f"execute_steps must be 1 to the chunk, {chunk}, got {config.evaluation.execute_steps}"
        )
    optim, devices = config.optim, jax.device_count()
    if optim.batch_size % (devices * optim.accumulate):
        parts = f" times {optim.accumulate} parts" if optim.accumulate > 1 else ""
        raise ValueError(
            f"batch_size must be a multiple of the {devices} devices{parts}, got {optim.batch_size}"
        )
    if jax.process_count() > 1 and config.data.fresh_every:
        raise ValueError("data.fresh_every needs one process: leave it out, or --distributed")
    if optim.ema and isinstance(config.peft, peft.AdaLoRA):
        raise ValueError("an average has no budget: leave --optim.ema out with ada_lora")


def _adapted(
    config: Config,
    model: Backbone,
    method: peft.Method,
    statistics: Mapping[str, jax.Array] = MappingProxyType({}),
) -> Backbone:
    """The model with the method on the run's targets, from the run's key."""
    rngs = nnx.Rngs(RandomStream.ADAPTERS.key(config.seed))
    rules = presets.rules(config.targets, method)
    return adaptation.adapt(model, rules, rngs=rngs, statistics=statistics)


def input_moments(run: Run, model: Backbone, processor: Processor) -> dict[str, jax.Array]:
    """`calibration.input_moments` of the run's targets, over batches as training draws them."""
    config, draw = run.config, _drawing(run, processor, model.config.chunk)

    def forward(model: Backbone, drawn: tuple[jax.Array, Batch]) -> Any:
        key, batch = drawn
        return model.loss(key, batch.observation, batch.actions, action_mask=batch.action_mask)

    keys = jax.random.split(RandomStream.STATISTICS.key(config.seed), STATISTICS_BATCHES)
    pattern = "|".join(f"(?:{path})" for path in presets.patterns(config.targets))
    batches = ((key, draw(key)) for key in keys)
    return calibration.input_moments(model, batches, pattern, forward)


def _drawing(run: Run, processor: Processor, chunk: int) -> Callable[[jax.Array], Batch]:
    """What gives a batch for a key, of a run that is not yet trained."""
    size, noise = run.config.optim.batch_size, run.config.optim.state_noise
    if run.streams:
        stream = Stream(run.steps, batch_size=size, chunk=chunk, seed=run.config.seed)
        return lambda key: encode(key, next(stream), processor, state_noise=noise)
    steps = jax.device_put(load_images(run.steps))
    return jax.jit(
        lambda key: sample_batch(
            key, steps, processor, batch_size=size, chunk=chunk, state_noise=noise
        )
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
    facts = found.metadata
    run.dataset, run.episodes, run.simulated = found.steps, outline(found), is_simulated(found)
    known = {name: facts[name] for name in ("crc32", "instructions")}
    streams = sum(x.nbytes for x in jax.tree.leaves(run.dataset)) > room
    run.streams = record_dataset(run.folder, known, streams=streams)
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
