"""Open the dataset of a run, convert it to a cache once, and group its episodes by task."""

import dataclasses
import functools
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.datasets.episodes import Episodes, concatenate
from envs.names import names
from lorasp_jax.base.bars import bars
from lorasp_jax.config import Config, DataConfig
from lorasp_jax.data import cache
from lorasp_jax.data.batches import Mixture, Steps
from lorasp_jax.data.cache import Cache
from lorasp_jax.data.joined import Part, parts_of
from lorasp_jax.data.keys import Keys
from lorasp_jax.data.opening import open_sources
from lorasp_jax.data.source import Progress, Source, grippers, hints, same_period
from lorasp_jax.data.split import held_out
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.policies.images import resize_with_pad, to_unit
from lorasp_jax.policies.processor import robot_slots
from lorasp_jax.training import offline
from lorasp_jax.training.distributed import processes
from lorasp_jax.training.run import Run
from lorasp_jax.training.run_folder import CACHE, record_dataset


def open_dataset(config: Config, model: BackboneConfig, folder: Path) -> Source:
    """Open the datasets at `config.data.source`, or their cache in `folder`.

    LeRobot images are resized to the model's image size.

    Raises:
        ValueError: a source is not a dataset, is corrupt, or is incompatible with the run or with
            the others.
    """
    cached = (folder / CACHE).exists()
    paths = [folder / CACHE] if cached else config.data.source
    keys, cameras = Keys(image_size=model.image_size), config.data.cameras
    source = open_sources(paths, keys, cameras, functools.partial(_square, model))
    _check_parts(config.data, model, parts_of(source))
    path = " + ".join(map(str, paths))
    if not same_period(source.control_dt, config.control_dt):
        raise ValueError(
            f"{path} has a control period of {source.control_dt:.4g} s, but this run has "
            f"--control-dt {config.control_dt:g}: pass --control-dt {source.control_dt:.4g}, or "
            "keep every N-th step with python -m lorasp_jax.data convert --every N"
        )
    _check_number_of_cameras(path, source, model)
    first = source.episode(0, ())
    if first.actions != "joint":
        raise ValueError(
            f"{path} has {first.actions} actions, but policies learn joint targets: "
            "collect with --actions joint"
        )
    lengths = first.state.shape[-1], first.action.shape[-1]
    try:
        for length in lengths:
            robot_slots(length - 1, model.inputs)
    except ValueError as error:
        raise ValueError(
            f"{path} does not fit the backbone: {error}; select entries with "
            "python -m lorasp_jax.data convert --state-numbers and --action-numbers"
        ) from error
    return source


def _check_number_of_cameras(path: str, source: Source, model: BackboneConfig) -> None:
    """Raise ValueError if there are more cameras than the backbone takes."""
    if len(source.cameras) > (most := len(model.cameras)):
        alike = "name those that show the same alike in dataset files, or " * bool(
            parts_of(source)[1:]
        )
        raise ValueError(
            f"{path} has cameras {', '.join(source.cameras)}, but the backbone accepts at most "
            f"{most}: {alike}choose with --data.cameras, such as --data.cameras "
            f"{' '.join([*source.cameras][:most])}"
        )


def _check_parts(data: DataConfig, model: BackboneConfig, parts: Sequence[Part]) -> None:
    """Raise ValueError unless the settings and the backbone fit the datasets."""
    known = f"the datasets are {', '.join(part.name for part in parts) or data.source[0]}"
    if data.replay and len(parts) < 2:
        raise ValueError(
            "data.replay needs demonstrations of what the base was taught: name their dataset last "
            f"in data.source, after the others; {known}"
        )
    if data.weights and len(data.weights) != max(1, len(parts) - bool(data.replay)):
        raise ValueError(
            f"data.weights needs a number for each dataset{' but the last' * bool(data.replay)}, "
            f"got {len(data.weights)}; {known}"
        )
    if blind := [part.name for part in parts if not part.cameras]:
        raise ValueError(f"{blind[0]} has none of --data.cameras {' '.join(data.cameras)}")
    every = {camera for part in parts for camera in part.cameras}
    for part in parts if not model.inputs.masks_missing else ():
        if missing := sorted(every - {*part.cameras}):
            raise ValueError(
                f"{part.name} has no camera {missing[0]}, and this backbone cannot mask a missing "
                f"one: choose those that all have with --data.cameras {' '.join(part.cameras)}"
            )


def _square(model: BackboneConfig, images: np.ndarray) -> np.ndarray:
    """Resize and pad images `[T, H, W, 3]` uint8 as the policy does, one by one: T varies."""
    return np.concatenate([np.asarray(_resized(image[None], model)) for image in images])


@functools.partial(jax.jit, static_argnames="model")
def _resized(image: jax.Array, model: BackboneConfig) -> jax.Array:
    options = {"centred": model.inputs.centred, "antialias": model.inputs.antialias}
    unit = resize_with_pad(to_unit("dataset", image), model.image_size, **options)
    return jnp.round(127.5 * (unit + 1)).astype(jnp.uint8)


def load(run: Run, source: Source, free_bytes: float) -> None:
    """Load the dataset of a run; stream it if it is larger than `free_bytes`."""
    data, made = run.config.data, not (run.folder / CACHE).exists()
    with bars(run.console, "steps") as progress:
        bar = progress.add_task(f"reading {' '.join(data.source)}", total=None)
        report = lambda done, total: progress.update(bar, completed=done, total=total)  # noqa: E731
        cache = as_cache(source, run.folder, report)
        if processes.is_first():  # the others read the same files
            cache.verify_images()
        progress.update(bar, completed=cache.num_steps, total=cache.num_steps)
    metadata = cache.metadata
    facts = (metadata[name] for name in ("tasks", "robot", "physics_dt"))
    run.recordings, run.simulated = cache, is_simulated(*facts)
    chosen = offline.choose(cache, run.config)
    run.held_out = _held_out(run, cache, chosen)
    unused = {*run.held_out, *chosen.left_out}
    steps = corrected_only(without(cache.steps, unused), cache, {*chosen.corrected} - unused)
    run.dataset, run.chosen = mixed(steps, data), chosen
    run.episodes = outline(cache, unused, chosen.corrected)
    identity = {name: metadata[name] for name in ("crc32", "instructions")}
    if run.held_out:
        identity["held_out"] = run.held_out
    if cache.parts[1:]:
        identity["datasets"] = shares(run.dataset, cache.parts)
    streams = sum(x.nbytes for x in jax.tree.leaves(run.dataset)) > free_bytes
    try:
        run.streams = record_dataset(run.folder, identity, streams=streams)
    except ValueError:
        if made and processes.is_first():  # the next attempt must read the dataset again
            shutil.rmtree(run.folder / CACHE, ignore_errors=True)
        raise
    run.config = dataclasses.replace(
        run.config, robot=metadata["robot"], tasks=tuple(metadata["tasks"])
    )
    _describe(run, cache, identity.get("datasets", []))
    offline.describe(chosen, cache, run.held_out, run.config.learn, run.console)


def _held_out(run: Run, cache: Cache, chosen: offline.Chosen) -> list[int]:
    """Return the episodes to hold out, which succeeded unless the policy imitates all.

    Raises:
        ValueError: there are too few episodes, or one was named that did not succeed.
    """
    validation, learn = run.config.data.validation, run.config.learn
    tasks, phrases = _labels(cache, run.config.data)
    among = None if learn == "imitation" else [n for n in chosen.successes if n < len(tasks)]
    offline.check(chosen, cache, (), learn)
    found = held_out(validation, tasks, phrases, recorded=not run.simulated, among=among)
    if among is not None and (wrong := sorted({*found} - {*among})):
        raise ValueError(
            f"data.validation names episode_{wrong[0]}, which did not succeed, so --learn {learn} "
            "cannot be measured on it: name one that did"
        )
    offline.check(chosen, cache, found, learn)
    return found


def _labels(cache: Cache, data: DataConfig) -> tuple[list[str], list[str]]:
    """Return task and instruction of each episode that may be held out.

    Tasks of different datasets are different ones.
    """
    last = len(cache) - cache.parts[-1].episodes if data.replay else len(cache)
    tasks, phrases = cache.tasks.tolist(), cache.phrases.tolist()
    if cache.parts[1:]:
        pairs = zip(tasks, cache.dataset, strict=True)
        tasks = [f"{task} of {cache.parts[index].name}" for task, index in pairs]
    return tasks[:last], phrases[:last]


def _describe(run: Run, cache: Cache, datasets: Sequence[Mapping[str, Any]]) -> None:
    """Print what is trained on."""
    console = run.console
    location = "streamed from disk" if run.streams else "held on the device"
    console.print(f"{cache.num_steps} steps in {len(cache)} episodes, {location}")
    assert run.chosen is not None
    learned = np.delete(cache.dataset, [*run.held_out, *run.chosen.left_out])
    for index, (part, each) in enumerate(zip(cache.parts, datasets, strict=False)):
        text = (
            f"  {100 * each['share']:.1f} % of the windows from {part.name}: "
            f"{(learned == index).sum()} episodes, {each['windows']} windows, cameras "
            f"{', '.join(part.cameras)}"
        )
        console.print(text, markup=False, soft_wrap=True)
    for text in _doubts(cache):
        console.print(f"warning: {text}", style="yellow", markup=False, soft_wrap=True)
    if datasets and run.config.data.statistics == "each":
        console.print(
            "each dataset is normalized by its own statistics; the policy acts for "
            f"{cache.parts[0].name} unless another is named with --dataset",
            markup=False,
            soft_wrap=True,
        )
    if run.held_out:
        names = ", ".join(map(str, run.held_out))
        console.print(f"held out of training: {len(run.held_out)} episodes ({names})")
    if recipe := run.augmentation:
        console.print(f"images change while training, by the recipe of {recipe.preset}")


def _doubts(cache: Cache) -> Iterator[str]:
    """Say which datasets seem to have other units or another robot than they should."""
    for index, part in enumerate(cache.parts):
        rows = cache.dataset[cache.episodes] == index
        texts = hints(np.asarray(cache.steps.state)[rows], grippers(cache, "state"))
        name = f"{part.name}: " * bool(cache.parts[1:])  # a single one has that of the cache
        yield from (f"{name}{text} to lorasp-jax inspect --save" for text in texts)
    if cache.parts[1:] and " + " in (robot := cache.metadata["robot"]):
        yield f"the robots are {robot}: their joints must have the same order, signs and units"


def as_cache(source: Source, folder: Path, progress: Progress) -> Cache:
    """Return the dataset as a cache, created in the run's folder if necessary."""
    if isinstance(source, Cache):
        return source
    if not (folder / CACHE).exists():
        cache.write([source], folder / CACHE, progress)
    return Cache(folder / CACHE)


def outline(
    dataset: Cache, left_out: Collection[int] = (), corrected: Collection[int] = ()
) -> dict[str, Episodes]:
    """Return the episodes of each task; one image per camera stands in for all others.

    Those that are left out, and tasks that have no others, are missing. Of those in `corrected`,
    each run of corrected steps is an episode.
    """
    episodes = {n: dataset.episode(n, ()) for n in range(len(dataset)) if n not in left_out}
    groups: dict[str, Episodes] = {}
    for task in dataset.metadata["tasks"]:
        indices = [index for index, episode in episodes.items() if episode.task == task]
        if not indices:
            continue
        parts = (_runs(x) if n in corrected else [x] for n, x in episodes.items() if n in indices)
        group = concatenate([part for pieces in parts for part in pieces])
        image = {
            name: np.broadcast_to(x[0, 0], (*group.state.shape[:2], *x.shape[2:]))
            for name, x in dataset.episode(indices[0]).image.items()
        }
        groups[task] = dataclasses.replace(group, image=image)
    return groups


def _runs(episode: Episodes) -> Iterator[Episodes]:
    """Yield the runs of corrected steps of an episode, each as an episode."""
    flags = np.pad(np.asarray(episode.corrected)[0], 1)
    for first, end in np.flatnonzero(flags[1:] != flags[:-1]).reshape(-1, 2):
        cut = {name: getattr(episode, name)[:, first:end] for name in ("state", "action")}
        flags_of_run = {"corrected": np.ones((1, end - first), bool)}
        length = np.array([end - first], np.int32)
        yield dataclasses.replace(episode, length=length, **cut, **flags_of_run)


def by_dataset(run: Run) -> list[list[Episodes]]:
    """Return the episodes to train on of each dataset, as `outline` does."""
    dataset, chosen = run.recordings, run.chosen
    assert dataset is not None
    assert chosen is not None
    index, unused = dataset.dataset.tolist(), {*run.held_out, *chosen.left_out}
    others = ({n for n, i in enumerate(index) if i != part} for part in range(len(dataset.parts)))
    return [[*outline(dataset, unused | rest, chosen.corrected).values()] for rest in others]


def without(steps: Steps, held_out: Collection[int]) -> Steps:
    """Return steps whose windows start in none of the episodes that are held out."""
    if not held_out:
        return steps
    episode = np.unique(steps.end, return_inverse=True)[1]
    starts = np.flatnonzero(~np.isin(episode, [*held_out])).astype(np.int32)
    return dataclasses.replace(steps, starts=starts)


def limit(run: Run, task: str) -> list[str]:
    """Limit the recordings of a run to a task or an instruction; return their instructions.

    What the run has held out stays so.

    Raises:
        ValueError: none of its episodes to train on are of the task.
    """
    assert run.recordings is not None
    assert run.dataset is not None
    cache, steps = run.recordings, run.dataset
    chosen = (cache.tasks == task) | (cache.phrases == task)
    starts = steps.start(np.arange(steps.num_starts, dtype=np.int32))
    starts = starts[chosen[cache.episodes[starts]]]
    if not len(starts):
        raise ValueError(f"{run.folder} trained on no episode of {task}")
    run.dataset = mixed(dataclasses.replace(steps, starts=starts, mixture=None), run.config.data)
    return [*dict.fromkeys(cache.phrases[chosen].tolist())]


def corrected_only(steps: Steps, cache: Cache, episodes: Collection[int]) -> Steps:
    """Return steps whose windows, in some episodes, start and end within runs of corrections."""
    if not episodes:
        return steps
    assert cache.corrected is not None
    rows, end = np.isin(cache.episodes, [*episodes]), np.asarray(steps.end)
    starts = steps.start(np.arange(steps.num_starts, dtype=np.int32))
    end = np.where(rows, offline.run_ends(cache.corrected, end), end)
    kept = starts[(~rows | cache.corrected)[starts]]
    return dataclasses.replace(steps, starts=kept, end=end)


def mixed(steps: Steps, data: DataConfig) -> Steps:
    """Return steps whose windows are drawn by `data.weights` and `data.replay`, if given."""
    if steps.dataset is None or not (data.weights or data.replay):
        return steps
    counts = _windows(steps)
    shares = np.array(data.weights or counts[: len(counts) - bool(data.replay)], float)
    shares *= (1 - data.replay) / shares.sum()
    shares = np.append(shares, [data.replay] * bool(data.replay)) * (counts > 0)
    shares = (shares / shares.sum()).astype(np.float32)
    bounds = np.append(0, np.cumsum(counts)).astype(np.int32)
    return dataclasses.replace(steps, mixture=Mixture(bounds, shares))


def shares(steps: Steps, parts: Sequence[Part]) -> list[dict[str, Any]]:
    """Describe datasets: name, episodes, windows to train on, and share of what is drawn."""
    counts = _windows(steps)
    drawn = counts / counts.sum() if steps.mixture is None else np.asarray(steps.mixture.shares)
    return [
        {"name": p.name, "episodes": p.episodes, "windows": int(n), "share": round(float(x), 6)}
        for p, n, x in zip(parts, counts, drawn, strict=True)
    ]


def _windows(steps: Steps) -> np.ndarray:
    """Return the number of windows of each dataset, `[D]`, of which some may have none."""
    assert steps.dataset is not None
    started = steps.dataset if steps.starts is None else steps.dataset[steps.starts]
    return np.bincount(started, minlength=steps.dataset[-1] + 1)


def is_simulated(tasks: Collection[str], robot: str, physics_dt: float) -> bool:
    """Whether a dataset was recorded in simulation and its tasks and robot are available.

    Matching names do not suffice: recordings of a real robot may use the same names.
    """
    is_known = set(tasks) <= set(names("task")) and robot in names("robot")
    return is_known and physics_dt > 0
