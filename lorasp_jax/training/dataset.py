"""A run's dataset: as a cache, made once where it is none, and what else a run asks of it."""

from pathlib import Path

import numpy as np

from envs.datasets.episodes import Episodes
from envs.names import names
from lorasp_jax.config import Config
from lorasp_jax.data import cache
from lorasp_jax.data.cache import Cache
from lorasp_jax.data.lerobot import Keys
from lorasp_jax.data.opening import open_source
from lorasp_jax.data.source import Progress, Source
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.policies.processor import robot_slots

_CACHE = Path("cache", "steps")
_SAME_TIME = 0.01  # relative; a rate of 30 Hz has no short decimals


def opened(config: Config, model: BackboneConfig, folder: Path) -> Source:
    """The dataset of `config.data.source`, or the cache of it that the run already has.

    Args:
        config: the run's.
        model: the backbone's; a LeRobot dataset's pictures are kept as large as it sees them.
        folder: the run's.

    Raises:
        ValueError: it is no dataset, is damaged, or does not fit the run.
    """
    made = folder / _CACHE
    where = made if made.exists() else config.data.source
    source = open_source(where, Keys(image_size=model.image_size))
    if abs(source.control_dt / config.control_dt - 1) > _SAME_TIME:
        raise ValueError(
            f"{where} has {source.control_dt:.4g} s between two steps, this run has --control-dt "
            f"{config.control_dt:g}: python -m lorasp_jax.data convert --every N takes every N-th"
        )
    if len(source.cameras) > len(model.cameras):
        raise ValueError(
            f"{where} has the cameras {', '.join(source.cameras)}, the backbone places for "
            f"{len(model.cameras)}: choose with python -m lorasp_jax.data convert --cameras"
        )
    _check_numbers(source.episode(0, ()), model, where)
    return source


def _check_numbers(first: Episodes, model: BackboneConfig, where: object) -> None:
    """Raise ValueError unless an episode's numbers are what a policy learns."""
    if first.actions != "joint":
        raise ValueError(
            f"{where} has actions of the kind {first.actions}, policies learn joint targets: "
            "collect with --actions joint"
        )
    try:
        robot_slots(first.state.shape[-1] - 1, model.inputs)
    except ValueError as error:
        raise ValueError(
            f"{where} does not fit the backbone: {error} Choose with python -m lorasp_jax.data "
            "convert --state-numbers and --action-numbers"
        ) from error


def cached(source: Source, folder: Path, progress: Progress) -> Cache:
    """A dataset as a cache in the folder of a run, unless it is one or another process made it."""
    if isinstance(source, Cache):
        return source
    if not (folder / _CACHE).exists():
        cache.write([source], folder / _CACHE, progress)
    return Cache(folder / _CACHE)


def outline(found: Cache) -> dict[str, Episodes]:
    """A cache's numbers by task; in place of all pictures, the task's first ones."""
    every = [found.episode(number, ()) for number in range(len(found))]
    groups: dict[str, Episodes] = {}
    for task in found.metadata["tasks"]:
        numbers = [number for number, episode in enumerate(every) if episode.task == task]
        groups[task] = _padded(found, [every[number] for number in numbers], numbers[0])
    return groups


def _padded(found: Cache, episodes: list[Episodes], first: int) -> Episodes:
    """Episodes of one task as one, with zeros up to the longest."""
    length = np.array([episode.num_steps for episode in episodes], np.int32)
    shape = (len(episodes), int(length.max()))
    begin = found.episode(first).image

    def pad(name: str) -> np.ndarray:
        rows = [np.asarray(getattr(episode, name))[0] for episode in episodes]
        padded = np.zeros((*shape, rows[0].shape[1]), np.float32)
        for to, row in zip(padded, rows, strict=True):
            to[: len(row)] = row
        return padded

    return Episodes(
        image={name: np.broadcast_to(x[0, 0], (*shape, *x.shape[2:])) for name, x in begin.items()},
        state=pad("state"),
        action=pad("action"),
        length=length,
        instruction=np.concatenate([episode.instruction for episode in episodes]),
        instructions=found.instructions,
        task=episodes[0].task,
        attempted=len(episodes),
        **{name: found.metadata[name] for name in cache.METADATA},
    )


def is_simulated(found: Cache) -> bool:
    """Whether a dataset is of simulated tasks and a robot that can be simulated here.

    A real robot's recordings may be called as a task is, but show and say other things.
    """
    known = set(names("task")), set(names("robot"))
    is_known = set(found.metadata["tasks"]) <= known[0] and found.metadata["robot"] in known[1]
    return is_known and found.metadata["physics_dt"] > 0
