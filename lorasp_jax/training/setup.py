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
from envs.episodes import Episodes
from lorasp_jax import adaptation, calibration, models, peft, tables
from lorasp_jax.config import Config
from lorasp_jax.data.batches import Batch, encode, sample_batch
from lorasp_jax.data.demonstrations import demonstrations
from lorasp_jax.data.imported import cached, is_simulated, opened, outline
from lorasp_jax.data.source import Source
from lorasp_jax.data.stream import Stream
from lorasp_jax.models import backbone, loading, places, presets, tokenizer
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.policy import Policy
from lorasp_jax.models.processing import Processor, Statistics, robot_slots, to_delta
from lorasp_jax.training import preflight
from lorasp_jax.training.loop import Run
from lorasp_jax.training.progress import bars

STATISTICS_BATCHES = 8
"""Batches that an initialization from data looks at."""
SIZES = ("nano", "small", "base")
TRAINING = "training.json"
"""File beside base weights: what they were trained on, with the control period."""


def prepare(config: Config, folder: Path, console: Console, started: float) -> Run:
    """Load or create the base, attach the adapters, get the demonstrations.

    What can be wrong with a config is found before anything long begins.

    Raises:
        ValueError: an unknown task, robot, backbone or size, a base that does not fit, a rule that
            matches nothing, a chunk or batch that does not fit.
    """
    for task in () if config.data.source else config.tasks:
        envs.make(
            task, robot=config.robot, image_size=config.image_size, control_dt=config.control_dt
        )
    words = tokenizer.load(config.model.tokenizer)
    base, base_hash = base_model(config)
    base = _changed(base, max_tokens=config.model.max_tokens or base.config.max_tokens)
    _check_sizes(config, base.config.chunk)
    source = opened(config, base.config, words, folder) if config.data.source else None
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
            run.episodes = _collect(run)
    relative = config.model.relative_actions
    found = processor([*run.episodes.values()], model.config, words, relative=relative)
    if config.peft.needs_statistics:
        statistics = input_moments(run, base, found)
        model = _adapted(config, base, config.peft, statistics)
    run.policy = Policy(model, found)
    return run


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
    chosen = config.model
    if chosen.size not in SIZES:
        raise ValueError(f"unknown size {chosen.size!r}: it is one of {', '.join(SIZES)}")
    wanted: BackboneConfig = getattr(backbone.find(chosen.backbone), chosen.size)()
    wanted = dataclasses.replace(wanted, dtype=chosen.dtype, param_dtype=chosen.param_dtype)
    if not wanted.inputs.masks_missing:
        wanted = dataclasses.replace(wanted, cameras=wanted.cameras[: len(envs.Env.cameras)])
    if chosen.source:
        folder = places.local(chosen.source)
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
    words: tokenizer.Tokenizer,
    *,
    relative: bool = False,
) -> Processor:
    """Statistics of the demonstrations and the token table of all their instructions, in order.

    The robot's cameras take the backbone's places in turn; there may be more places than cameras.

    Args:
        episodes: by task.
        model_config: sizes and inputs.
        words: of the instructions.
        relative: joint targets are learned relative to the state that a chunk starts from.
    """
    joints = episodes[0].state.shape[-1] - 1
    slots, dim = robot_slots(joints, model_config.inputs), model_config.action_dim
    delta = (*[True] * joints, False) if relative else ()
    pairs = [_windows(e, model_config.chunk if relative else 1) for e in episodes]
    state, action = (jnp.concatenate(arrays) for arrays in zip(*pairs, strict=True))
    action = np.asarray(to_delta(action, state, delta)).reshape(-1, joints + 1)
    state = np.repeat(np.asarray(state), len(action) // len(state), axis=0)
    everything = np.ones(len(state), bool)
    statistics = Statistics.measure(state, action, everything, slots=slots, dim=dim)
    phrases = [phrase for group in episodes for phrase in group.instructions]
    tokens = words.encode(phrases, model_config.max_tokens)
    cameras = dict(zip(model_config.cameras, sorted(episodes[0].image), strict=False))
    return Processor.of(
        model_config, statistics, tokens, num_joints=joints, cameras=cameras, delta=delta
    )


def _windows(episodes: Episodes, chunk: int) -> tuple[np.ndarray, np.ndarray]:
    """States `[N, J+1]` of all valid steps and the actions `[N, C, J+1]` from there on.

    As in training, the last action of an episode is repeated.
    """
    length = np.asarray(episodes.length)[:, None]
    steps = np.arange(episodes.state.shape[1])
    valid = steps < length
    following = np.minimum(steps[:, None] + np.arange(chunk), length[..., None] - 1)
    rows = np.arange(len(length))[:, None, None]
    actions = np.asarray(episodes.action)[rows, following]
    return np.asarray(episodes.state)[valid], actions[valid]


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


def _collect(run: Run) -> dict[str, Episodes]:
    """Demonstrations by task, with a bar each."""
    with bars(run.console, "episodes") as progress:
        started: dict[str, TaskID] = {}

        def report(task: str, done: int, total: int) -> None:
            text = f"collecting {task}" if done else f"compiling the expert of {task} ..."
            if task not in started:
                started[task] = progress.add_task(text, total=total)
            progress.update(started[task], completed=done, description=text)

        return demonstrations(run.config, run.folder, report)
