"""Export any dataset as RLDS for other programs; for training, write a cache instead."""

import os
from pathlib import Path
from typing import Any

from envs.datasets import rlds
from envs.datasets.episodes import concatenate, labelled
from lorasp_jax.base.locks import locked
from lorasp_jax.base.writing import atomic_folder
from lorasp_jax.data.source import Progress, Source, dimensions

EPISODES_PER_FILE = 16
"""Number of episodes per file, all in memory until it is written."""


def to_rlds(source: Source, path: str | os.PathLike[str], progress: Progress) -> None:
    """Write an RLDS folder (see `envs.datasets.rlds`), which appears only once it is complete.

    Args:
        source: a dataset of one task; not modified.
        path: folder to create.
        progress: called with the steps done and the total.

    Raises:
        ValueError: the path already exists, another process is writing it, there are several tasks,
            or metadata differs between episodes.
        OSError: the disk is full.
    """
    tasks = sorted({source.episode(number, ()).task for number in (0, len(source) - 1)})
    if len(tasks) > 1:  # fail now, not after hours of writing images
        raise ValueError(f"an RLDS dataset can hold only one task, got {', '.join(tasks)}")
    with locked(Path(path)), atomic_folder(path) as folder:
        writer, done = rlds.ShardWriter(folder, _options(source)), 0
        for first in range(0, len(source), EPISODES_PER_FILE):
            numbers = range(first, min(first + EPISODES_PER_FILE, len(source)))
            shard = []
            for number in numbers:
                shard.append(labelled(source.episode(number)))  # RLDS takes None for success
                done += shard[-1].num_steps
                progress(done, source.num_steps)
            writer.append(concatenate(shard))
        writer.complete()


def _options(source: Source) -> dict[str, Any]:
    """Return what is known of the dimensions, as `rlds.ShardWriter` keeps it."""
    known = dimensions(source)
    options: dict[str, Any] = {"grippers": known["grippers"]}
    if names := known.get("names"):
        options |= {"names": names["state"], "action_names": names["action"]}
    return options
