"""Open the dataset of a run, convert it to a cache once, and group its episodes by task."""

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
    source = open_source(path, Keys(image_size=model.image_size))
    if abs(source.control_dt / config.control_dt - 1) > _DT_TOLERANCE:
        raise ValueError(
            f"{path} has a control period of {source.control_dt:.4g} s, but this run has "
            f"--control-dt {config.control_dt:g}: pass --control-dt {source.control_dt:.4g}, or "
            "keep every N-th step with python -m lorasp_jax.data convert --every N"
        )
    if len(source.cameras) > len(model.cameras):
        raise ValueError(
            f"{path} has cameras {', '.join(source.cameras)}, but the backbone accepts at most "
            f"{len(model.cameras)}: select cameras with python -m lorasp_jax.data convert --cameras"
        )
    _check_state_and_actions(source.episode(0, ()), model, path)
    return source


def _check_state_and_actions(first: Episodes, model: BackboneConfig, path: object) -> None:
    """Raise ValueError unless a policy can learn from the states and actions of an episode."""
    if first.actions != "joint":
        raise ValueError(
            f"{path} has {first.actions} actions, but policies learn joint targets: "
            "collect with --actions joint"
        )
    try:
        robot_slots(first.state.shape[-1] - 1, model.inputs)
    except ValueError as error:
        raise ValueError(
            f"{path} does not fit the backbone: {error}; select entries with "
            "python -m lorasp_jax.data convert --state-numbers and --action-numbers"
        ) from error


def as_cache(source: Source, folder: Path, progress: Progress) -> Cache:
    """Return the dataset as a cache, created in the run's folder if necessary."""
    if isinstance(source, Cache):
        return source
    if not (folder / CACHE).exists():
        cache.write([source], folder / CACHE, progress)
    return Cache(folder / CACHE)


def outline(dataset: Cache) -> dict[str, Episodes]:
    """Return the episodes of each task; one image per camera stands in for all others."""
    episodes = [dataset.episode(index, ()) for index in range(len(dataset))]
    groups: dict[str, Episodes] = {}
    for task in dataset.metadata["tasks"]:
        indices = [index for index, episode in enumerate(episodes) if episode.task == task]
        groups[task] = _pad(dataset, [episodes[index] for index in indices], indices[0])
    return groups


def _pad(dataset: Cache, episodes: list[Episodes], first: int) -> Episodes:
    """Stack the episodes of one task, padded with zeros to the length of the longest."""
    length = np.array([episode.num_steps for episode in episodes], np.int32)
    shape = (len(episodes), int(length.max()))
    images = dataset.episode(first).image

    def pad(name: str) -> np.ndarray:
        rows = [np.asarray(getattr(episode, name))[0] for episode in episodes]
        padded = np.zeros((*shape, rows[0].shape[1]), np.float32)
        for target, row in zip(padded, rows, strict=True):
            target[: len(row)] = row
        return padded

    return Episodes(
        image={
            name: np.broadcast_to(x[0, 0], (*shape, *x.shape[2:])) for name, x in images.items()
        },
        state=pad("state"),
        action=pad("action"),
        length=length,
        instruction=np.concatenate([episode.instruction for episode in episodes]),
        instructions=dataset.instructions,
        task=episodes[0].task,
        attempted=len(episodes),
        **{name: dataset.metadata[name] for name in cache.METADATA},
    )


def is_simulated(dataset: Cache) -> bool:
    """Whether a dataset was recorded in simulation and its tasks and robot are available.

    Matching names do not suffice: recordings of a real robot may use the same names.
    """
    metadata = dataset.metadata
    is_known = set(metadata["tasks"]) <= set(names("task")) and metadata["robot"] in names("robot")
    return is_known and metadata["physics_dt"] > 0
