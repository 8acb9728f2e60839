"""Any dataset in RLDS form, for whoever reads that; `cache.write` is what training needs."""

import os
from pathlib import Path

from envs.datasets import rlds
from envs.datasets.episodes import concatenate
from envs.datasets.locks import locked
from envs.datasets.writing import creating
from lorasp_jax.data.source import Progress, Source


def to_rlds(
    source: Source,
    path: str | os.PathLike[str],
    progress: Progress,
    *,
    episodes_per_file: int = 16,
) -> None:
    """Writes an RLDS folder, which is there only when all of it is; see `envs.datasets.rlds`.

    Args:
        source: a dataset of one task; it is not changed.
        path: the folder to make.
        progress: called with the steps that are done and all that are to be.
        episodes_per_file: so many are in memory at a time.

    Raises:
        ValueError: the path exists already, another process is writing it, there are several tasks,
            or the episodes differ in more than their steps.
        OSError: there is no room for it.
    """
    tasks = sorted({source.episode(number, ()).task for number in (0, len(source) - 1)})
    if len(tasks) > 1:  # now, not when hours of the first one's pictures are written
        raise ValueError(f"an RLDS folder holds one task, not {', '.join(tasks)}")
    with locked(Path(path)), creating(path) as folder:
        parts, done = rlds.Parts(folder, {}), 0
        for first in range(0, len(source), episodes_per_file):
            numbers = range(first, min(first + episodes_per_file, len(source)))
            part = []
            for number in numbers:
                part.append(source.episode(number))
                done += part[-1].num_steps
                progress(done, source.num_steps)
            parts.append(concatenate(part))
        parts.complete()
