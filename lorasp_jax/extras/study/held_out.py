"""Demonstrations that cells share: those to train on, and held-out ones that no cell trains on."""

import dataclasses
import hashlib
import json
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from envs.datasets.episodes import Episodes
from lorasp_jax.base.locks import locked
from lorasp_jax.config import Config, DataConfig
from lorasp_jax.training.demonstrations import Demonstrations, Progress, demonstrations, map_threads
from lorasp_jax.training.run_folder import to_json

_SILENT: Progress = lambda *_: None  # noqa: E731
EPISODES = 32
"""Held-out episodes per task."""
SEED = 2**32 - 1
"""Seed of the held-out episodes; no cell may have it."""


def shared_demonstrations(
    study_folder: Path,
    pool: int,
    config: Config,
    _folder: Path | None = None,
    progress: Progress = _SILENT,
) -> Demonstrations:
    """Load the demonstrations that cells with the same robot, scene and data settings share.

    They do not depend on the seed, and a task has the same ones whatever tasks it is trained with.
    The first cell that needs them collects them. With a `pool`, that many are collected, and each
    seed takes its own at random.
    """
    count = config.data.episodes
    shared = _collecting(config, pool or count, seed=0)
    found = _shared(study_folder / "demonstrations", shared, progress)
    if not pool:
        return found
    own = np.sort(np.random.default_rng(config.seed).permutation(pool)[:count])
    return {task: episodes.select(own) for task, episodes in found.items()}


def held_out_demonstrations(study_folder: Path, config: Config) -> Demonstrations:
    """Load the held-out demonstrations (see `settings`), shared in the same way."""
    return _shared(study_folder / "held_out", settings(config))


def settings(config: Config) -> Config:
    """Return the config whose demonstrations are the held-out episodes of a run.

    Raises:
        ValueError: the run has the seed of the held-out episodes.
    """
    if config.seed == SEED:
        raise ValueError(f"seed {SEED} is reserved for held-out episodes")
    return _collecting(config, EPISODES, SEED)


def _collecting(config: Config, episodes: int, seed: int) -> Config:
    """Return the config of a collection, with none of the settings of training on it."""
    kept = {name: getattr(config.data, name) for name in ("num_envs", "action_noise")}
    return dataclasses.replace(config, data=DataConfig(episodes=episodes, **kept), seed=seed)


def _shared(root: Path, config: Config, progress: Progress = _SILENT) -> Demonstrations:
    """Load each task's episodes from a folder named after the settings, or collect them there."""
    settings = {
        "robot": config.robot,
        "data": to_json(config)["data"],
        "image_size": config.image_size,
        "control_dt": config.control_dt,
    }
    if ranges := config.scene.changed():
        settings["scene"] = ranges
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]
    folder = root / f"{Path(config.robot).stem}_{digest}"

    def one(task: str):
        single = dataclasses.replace(config, tasks=(task,))
        file = folder / "cache" / f"{task}.npz"
        alone = nullcontext() if file.exists() else locked(file, waiting=lambda: None)
        with alone:  # one process at a time makes a file; nobody waits once it exists
            return demonstrations(single, folder, progress)[task]

    return dict(zip(config.tasks, map_threads(one, config.tasks), strict=True))


class AllTasks:
    """Demonstrations as a dataset: the episodes of all tasks, numbered one after the other."""

    def __init__(self, demonstrations: Demonstrations) -> None:
        self._groups = [*demonstrations.values()]
        self.control_dt = self._groups[0].control_dt

    def __len__(self) -> int:
        return sum(group.num_episodes for group in self._groups)

    def episode(self, number: int, cameras: object = None) -> Episodes:  # noqa: ARG002
        """Return one episode."""
        for group in self._groups:
            if number < group.num_episodes:
                return group.select([number])
            number -= group.num_episodes
        raise IndexError(number)
