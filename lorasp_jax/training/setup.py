"""Build a run from a config: base, adapters, demonstrations and processor."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
from flax import nnx
from rich.console import Console
from rich.progress import TaskID

import envs
from envs.env import Env
from lorasp_jax import peft
from lorasp_jax.adapters import adaptation, paths, summary
from lorasp_jax.adapters.io import native
from lorasp_jax.base import hub
from lorasp_jax.base.bars import bars
from lorasp_jax.config import Config
from lorasp_jax.data.augmentation import on_wrist
from lorasp_jax.data.source import Source, describe_left_out
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.policies import prompts
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor, robot_slots
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.tokenizer import Offline, Tokenizer, load_tokenizer
from lorasp_jax.training import advantage, dataset, protect, rules
from lorasp_jax.training.activations import input_moments
from lorasp_jax.training.base import base_model, quantized, with_config
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.demonstrations import Demonstrations, Progress, demonstrations, in_thread
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.distributed import processes
from lorasp_jax.training.processors import of_datasets, processor
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.relative import for_robot
from lorasp_jax.training.replay import with_replayed
from lorasp_jax.training.run import Run

Collect = Callable[[Config, Path, Progress], Demonstrations]
"""Signature of `demonstrations`."""
Meanwhile = Callable[[Run, "RunSetup"], Any]
"""What `prepare` runs while it collects demonstrations."""


@dataclasses.dataclass(frozen=True)
class RunSetup:
    """Everything a run needs except demonstrations.

    Attributes:
        base: the frozen base, with the chosen rematerialization.
        model: the base with adapters, before any data-driven initialization.
        prompts: prompts of all instructions.
        joints: number of robot joints J.
        environments: one per task; empty if the config names a dataset.
        source: the dataset; None if the expert collects demonstrations.
        memory: estimate for one step.
        available: device memory [bytes].
        free_bytes: device memory that training and evaluating leave for the dataset [bytes].
    """

    base: Backbone
    base_hash: str
    model: Backbone
    prompts: PromptTable
    joints: int
    environments: Sequence[Env]
    source: Source | None
    memory: preflight.Memory
    available: float
    free_bytes: float


def build(
    config: Config, folder: Path, *, abstract: bool = False, budget: float | None = None
) -> RunSetup:
    """Load or create the base and attach the adapters, without writing to `folder`.

    This validates the config before any long-running work. With `abstract`, for a dry run, the
    adapted model has only shapes. A remote dataset is then still downloaded, but not a remote base
    or tokenizer; the bundled tokenizer is used instead. `budget` is the memory that the run should
    need at most, with its dataset [bytes]; None: that of the device.

    Raises:
        ValueError: an unknown task, robot, backbone or size, an incompatible base or tokenizer, a
            target that matches no layer, or an invalid batch size or number of steps to execute.
    """
    if config.protect:
        protect.check(config)
    sizes = {"image_size": config.image_size, "control_dt": config.control_dt}
    tasks = () if config.data.source else with_replayed(config).tasks
    environments = [envs.make(task, robot=config.robot, **sizes) for task in tasks]
    use_bundled = abstract and hub.is_remote(config.model.tokenizer)
    tokenizer = load_tokenizer("" if use_bundled else config.model.tokenizer)
    base, base_hash = base_model(config, abstract=abstract)
    rules.check_plan(config, base)
    spoken = protect.processor(config).prompts.instructions if config.protect else ()
    chosen = {name: getattr(config.model, name) for name in ("max_tokens", "chunk")}
    base = with_config(base, **{name: value for name, value in chosen.items() if value})
    source = dataset.open_dataset(config, base.config, folder) if config.data.source else None
    if source and not base.config.inputs.masks_missing:
        base = with_config(base, cameras=base.config.cameras[: len(source.cameras)])
    endings = ("",)
    if config.learn == "recap":
        short = isinstance(tokenizer, Offline)
        endings = prompts.ADVANTAGE_SHORT if short else prompts.ADVANTAGE
    table, joints = _prompts_and_joints(
        source, environments, tokenizer, base.config, endings, spoken
    )
    check_sizes(config, base.config.chunk)
    if not source:
        robot_slots(joints, base.config.inputs)
    relative = config.model.relative_actions
    base = with_config(base, inputs=for_robot(base.config.inputs, relative, source, joints))
    available = preflight.available_bytes()
    remat, memory = preflight.choose_remat(config, base.config, available)
    base = with_config(base, remat=remat)
    free_bytes = available - memory.peak
    if budget is not None:
        evaluating = preflight.sampling_peak(config, base.config)
        free_bytes = min(available, budget) - max(memory.peak, evaluating)
    model = (
        preflight.abstract_model(config, base.config)
        if abstract
        else _adapt(config, base, rules.rules(config, as_saved=True))
    )
    found = (base, base_hash, model, table, joints, environments, source)
    return RunSetup(*found, memory, available, free_bytes)


def prepare(
    config: Config,
    folder: Path,
    console: Console,
    started: float,
    *,
    collect: Collect = demonstrations,
    meanwhile: Sequence[Meanwhile] = (),
    budget: float | None = None,
) -> Run:
    """Build a run and load or collect its demonstrations.

    Args:
        started: `time.perf_counter()` when this process started.
        meanwhile: functions that compile what the run needs next, in threads of their own until
            the demonstrations are there. Their errors are raised here.
        budget: see `build`.

    Raises:
        ValueError: see `build`; also if the dataset cannot be read or the expert fails.
    """
    built = build(config, folder, budget=budget)
    base, model = built.base, built.model
    processes.agree("base models", {"base": built.base_hash, "remat": base.config.remat})
    console.print(headline(config, model))
    console.print(f"memory per device: {built.memory}; rematerialization: {base.config.remat}")
    run = Run(config, folder, console, built.base_hash, started)
    _load_or_collect(run, built, collect, meanwhile)
    groups, cameras = [*run.episodes.values()], config.data.cameras
    inputs = processor(groups, model.config, built.prompts, cameras=cameras)
    if run.recordings and (parts := run.recordings.parts)[1:]:
        each = config.data.statistics == "each"
        groups = dataset.by_dataset(run) if each else ()
        inputs = of_datasets(inputs, model.config, parts, groups)
    if config.learn == "recap":
        assert run.dataset is not None
        rows = advantage.prompt_rows(run, model, inputs)
        run.dataset = dataclasses.replace(run.dataset, instruction=rows)
    if config.protect:
        inputs = protect.with_statistics(config, inputs)
        run.fixed = protect.fixed(model, protect.directions(run, model, collect))
    if any(method.needs_statistics for method in rules.methods(config)):
        moments = input_moments(run, quantized(base, config.model.base_dtype), inputs)
        model = _adapt(config, base, rules.rules(config), moments)
    if built.source:
        _print_cameras(built.source, inputs, console)
    run.policy = Policy(model, inputs)
    return run


def _print_cameras(source: Source, inputs: Processor, console: Console) -> None:
    if unused := describe_left_out(source):
        console.print(unused, markup=False, soft_wrap=True)
    cameras = [f"{name} -> {slot}" for slot, name in inputs.cameras if name]
    size = f"{inputs.image_size} x {inputs.image_size}"
    summary = f"cameras: {', '.join(cameras)}; resized to {size}"
    console.print(summary, markup=False, soft_wrap=True)
    slots = [slot for slot, _ in inputs.cameras]
    wrong = [n for slot, n in inputs.cameras if n and on_wrist(n) and not on_wrist(slot)]
    if wrong and any(map(on_wrist, slots)):
        text = (
            f"warning: {wrong[0]} is named like a wrist camera, but takes another's place: choose "
        )
        text += "the order with --data.cameras"
        console.print(text, style="yellow", highlight=False, soft_wrap=True)


def _load_or_collect(
    run: Run, built: RunSetup, collect: Collect, meanwhile: Sequence[Meanwhile]
) -> None:
    """Load the dataset or collect demonstrations, with `meanwhile` in threads, and wait for all."""
    with run.timed("collect"), processes.first_process_first("collected"):
        futures = [in_thread(function, run, built) for function in meanwhile]
        if built.source:
            dataset.load(run, built.source, built.free_bytes)
        else:
            phrases = [phrase for env in built.environments for phrase in env.instructions]
            run.episodes = _collect(run, phrases, collect)
        for future in futures:
            future.result()
    run.streams = processes.any_process(run.streams)  # all or none: they share batches


def headline(config: Config, model: Backbone) -> str:
    """Summarize scale, method, backbone and trainable parameters; `adapt` adds a line per rule."""
    parts = rules.by_rule(config, model).items() if config.adapt else ()
    first = (
        f"scale {config.scale}: {rules.describe(config)} on {config.model.backbone} "
        f"{config.model.size}, {summary.trained_share(model)}"
    )
    counted = [
        f"  {rule}: {n['layers']} layers, {n['parameters']:,} parameters" for rule, n in parts
    ]
    return "\n".join([first, *counted])


def _prompts_and_joints(
    source: Source | None,
    environments: Sequence[Env],
    tokenizer: Tokenizer,
    model: BackboneConfig,
    endings: Sequence[str] = ("",),
    more: Sequence[str] = (),
) -> tuple[PromptTable, int]:
    """Return the prompts for all instructions, then more, and the robot's number of joints."""
    if source is None:
        joints = environments[0].robot.num_joints
        phrases = [phrase for env in environments for phrase in env.instructions]
    else:
        first = source.episode(0, ())
        joints, phrases = first.state.shape[-1] - 1, [*first.instructions]
    phrases += [phrase for phrase in more if phrase not in phrases]
    try:
        return PromptTable.of(tokenizer, phrases, model, num_joints=joints, endings=endings), joints
    except ValueError as error:
        if source is None:
            raise
        need = "need a different --model.tokenizer or --model.max-tokens"
        raise ValueError(f"the dataset's instructions {need}: {error}") from error


def check_sizes(config: Config, chunk: int) -> None:
    """Raise ValueError if chunk, batch, devices or training options cannot be combined."""
    meshes.make_mesh(config.fsdp)
    if config.evaluation.execute_steps > chunk:
        raise ValueError(
            f"evaluation.execute_steps must be between 1 and the chunk length {chunk}, got "
            f"{config.evaluation.execute_steps}"
        )
    optim, devices = config.optim, jax.device_count()
    if optim.rtc_max_delay >= chunk:
        raise ValueError(
            f"optim.rtc_max_delay must be below the chunk length {chunk}, got {optim.rtc_max_delay}"
        )
    if optim.batch_size % (devices * optim.accumulate):
        micro = f" x {optim.accumulate} micro-batches" if optim.accumulate > 1 else ""
        raise ValueError(
            f"batch_size must be a multiple of {devices * optim.accumulate} ({devices} devices"
            f"{micro}), got {optim.batch_size}"
        )
    if jax.process_count() > 1 and config.data.fresh_every:
        raise ValueError("data.fresh_every cannot be combined with --distributed: drop one")
    if optim.ema and any(isinstance(method, peft.AdaLoRA) for method in rules.methods(config)):
        raise ValueError(
            "--optim.ema cannot be combined with ada_lora: averaging breaks its rank budget"
        )


def _adapt(
    config: Config,
    model: Backbone,
    adapter_rules: paths.Rules,
    statistics: Mapping[str, jax.Array] = MappingProxyType({}),
) -> Backbone:
    """Add adapters, by rule from the run's seed or the start run's, and quantize the base."""
    if config.protect:
        return quantized(native.load_adapters(config.protect, model), config.model.base_dtype)
    rngs = nnx.Rngs(RandomStream.ADAPTERS.key(config.seed))
    # No variable holds the adapted model, whose memory `quantized` frees.
    return quantized(
        adaptation.adapt(model, adapter_rules, rngs=rngs, statistics=statistics),
        config.model.base_dtype,
    )


def _collect(run: Run, instructions: Sequence[str], collect: Collect) -> Demonstrations:
    """Collect demonstrations, with a progress bar per task."""
    with bars(run.console, "episodes") as progress:
        bar_ids: dict[str, TaskID] = {}

        def report(task: str, done: int, total: int) -> None:
            text = f"collecting {task}" if done else f"compiling the expert for {task} ..."
            if task not in bar_ids:
                bar_ids[task] = progress.add_task(text, total=total)
            progress.update(bar_ids[task], completed=done, description=text)

        config = with_replayed(run.config)
        if replayed := config.tasks[len(run.config.tasks) :]:
            share = f"{100 * config.data.replay:g} % of the windows"
            run.console.print(f"{share} are of what the base was taught: {', '.join(replayed)}")
        episodes = collect(config, run.folder, report)
    # Steps refer to instructions by index.
    if [phrase for group in episodes.values() for phrase in group.instructions] != [*instructions]:
        raise ValueError(
            f"{run.folder} contains demonstrations with different instructions: use another --name"
        )
    return episodes
