"""Open a dataset of any supported format, recognized by its files."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

from envs.datasets import rlds
from lorasp_jax.base import hub
from lorasp_jax.data.cache import HEADER, Cache
from lorasp_jax.data.lerobot import Keys, LeRobot
from lorasp_jax.data.source import Source


def open_source(
    where: str | os.PathLike[str], keys: Keys | None = None, cameras: Sequence[str] = ()
) -> Source:
    """Open a LeRobot or RLDS dataset, or a cache.

    Args:
        where: a path, or hf://owner/name of a LeRobot dataset on the Hub.
        keys: feature mapping of a LeRobot dataset; other formats ignore `image_size` and reject
            all other settings.
        cameras: names of the cameras to use; empty: all.

    Raises:
        ValueError: the dataset is missing, damaged or in an unknown format, or `keys` does not fit
            its format.
    """
    path = hub.local(where, repository="dataset")
    if (path / "meta" / "info.json").is_file():
        return LeRobot(path, keys, name=Path(where).name, cameras=cameras)
    if keys and dataclasses.replace(keys, image_size=0) != Keys():
        raise ValueError(f"{where} is not a LeRobot dataset: --state, --angles etc. do not apply")
    if (path / HEADER).is_file():
        return Cache(path, cameras)
    if (path / rlds.METADATA).is_file():
        return rlds.Reader(path, cameras)
    raise ValueError(
        f"{where} is not a dataset: expected a folder with meta/info.json (LeRobot), "
        f"{rlds.METADATA} (RLDS, from python -m envs collect) or {HEADER} (cache)"
    )
