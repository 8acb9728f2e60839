"""Open the dataset of a run, convert it to a cache once, and group its episodes by task."""

import dataclasses
from collections.abc import Collection
from pathlib import Path

import numpy as np

from envs.datasets.episodes import Episodes, concatenate
from envs.names import names
from lorasp_jax.config import Config
from lorasp_jax.data import cache
from lorasp_jax.data.batches import Steps
from lorasp_jax.data.cache import Cache
from lorasp_jax.data.lerobot import Keys
from lorasp_jax.data.opening import open_source
from lorasp_jax.data.source import Progress, Source
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.policies.processor import robot_slots

CACHE = Path("cache", "steps")
_DT_TOLERANCE = 0.01  # relative; 1/30 s has no exact decimal representation


def open_dataset(config: Config, model: BackboneConfig, folder: Path) -> Source:
    """Open the dataset at `config.data.source`, or its cache in `folder`.

    LeRobot images are resized to the model's image size.

    Raises:
        ValueError: the source is not a dataset, is corrupt, or is incompatible with the run.
    """
    cache_folder = folder / CACHE
    path = cache_folder if cache_folder.exists() else config.data.source
    source = open_source(path, Keys(image_size=model.image_size), config.data.cameras)
    if not has_period(source, config.control_dt):
        raise ValueError(
            f"{path} has a control period of {source.control_dt:.4g} s, but this run has "
            f"--control-dt {config.control_dt:g}: pass --control-dt {source.control_dt:.4g}, or "
            "keep every N-th step with python -m lorasp_jax.data convert --every N"
        )
    if len(source.cameras) > (most := len(model.cameras)):
        raise ValueError(
            f"{path} has cameras {', '.join(source.cameras)}, but the backbone accepts at most "
            f"{most}: choose with --data.cameras, such as --data.cameras "
            f"{' '.join([*source.cameras][:most])}"
        )
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


def has_period(source: Source, control_dt: float) -> bool:
    """Whether the time between two actions is `control_dt` [s]."""
    return abs(source.control_dt / control_dt - 1) <= _DT_TOLERANCE


def as_cache(source: Source, folder: Path, progress: Progress) -> Cache:
    """Return the dataset as a cache, created in the run's folder if necessary."""
    if isinstance(source, Cache):
        return source
    if not (folder / CACHE).exists():
        cache.write([source], folder / CACHE, progress)
    return Cache(folder / CACHE)


def outline(dataset: Cache, held_out: Collection[int] = ()) -> dict[str, Episodes]:
    """Return the episodes of each task; one image per camera stands in for all others.

    Those that are held out are left out.
    """
    episodes = {n: dataset.episode(n, ()) for n in range(len(dataset)) if n not in held_out}
    groups: dict[str, Episodes] = {}
    for task in dataset.metadata["tasks"]:
        indices = [index for index, episode in episodes.items() if episode.task == task]
        group = concatenate([episodes[index] for index in indices])
        image = {
            name: np.broadcast_to(x[0, 0], (*group.state.shape[:2], *x.shape[2:]))
            for name, x in dataset.episode(indices[0]).image.items()
        }
        groups[task] = dataclasses.replace(group, image=image)
    return groups


def without(steps: Steps, held_out: Collection[int]) -> Steps:
    """Return steps whose windows start in none of the episodes that are held out."""
    if not held_out:
        return steps
    episode = np.unique(steps.end, return_inverse=True)[1]
    starts = np.flatnonzero(~np.isin(episode, [*held_out])).astype(np.int32)
    return dataclasses.replace(steps, starts=starts)


def is_simulated(tasks: Collection[str], robot: str, physics_dt: float) -> bool:
    """Whether a dataset was recorded in simulation and its tasks and robot are available.

    Matching names do not suffice: recordings of a real robot may use the same names.
    """
    is_known = set(tasks) <= set(names("task")) and robot in names("robot")
    return is_known and physics_dt > 0
