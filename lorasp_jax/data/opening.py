"""Open a dataset of any supported format, recognized by its files."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

from envs.datasets import rlds
from envs.datasets.episodes import choose_cameras
from lorasp_jax.base import hub
from lorasp_jax.data import dataset_file
from lorasp_jax.data.cache import HEADER, Cache
from lorasp_jax.data.joined import Fit, Joined, Renamed
from lorasp_jax.data.lerobot import Keys, LeRobot
from lorasp_jax.data.source import Source


def open_sources(
    wheres: Sequence[str | os.PathLike[str]],
    keys: Keys,
    cameras: Sequence[str] = (),
    fit: Fit | None = None,
) -> Source:
    """Open one dataset, or join several; for arguments and errors, see `open_source` and `Joined`.

    The name of a dataset is the last part of its path, or the whole path if others have it, too.
    """
    if len(wheres) == 1:
        return open_source(wheres[0], keys, cameras)
    paths = [os.fspath(where) for where in wheres]
    real = [_real(path) for path in paths]
    if twice := [path for path, where in zip(paths, real, strict=True) if real.count(where) > 1]:
        other = f", also as {twice[1]}" * (twice[1] != twice[0])
        raise ValueError(f"{twice[0]} is named twice{other}")
    short = [_name(path) for path in paths]
    names = dict(zip(short if len({*short}) == len(short) else paths, paths, strict=True))
    return Joined({name: open_source(path, keys) for name, path in names.items()}, cameras, fit)


def open_source(
    where: str | os.PathLike[str], keys: Keys | None = None, cameras: Sequence[str] = ()
) -> Source:
    """Open a LeRobot or RLDS dataset, or a cache, or what a dataset file names.

    Args:
        where: a path, or hf://owner/name of a LeRobot dataset on the Hub.
        keys: feature mapping of a LeRobot dataset; other formats ignore `image_size`, can rename
            cameras and reject all other settings. A dataset file has its own, but `image_size`.
        cameras: names of the cameras to use; empty: all.

    Raises:
        ValueError: the dataset is missing, damaged or in an unknown format, or `keys` does not fit
            its format.
    """
    name = _name(where)
    if dataset_file.is_file(where):
        if keys and dataclasses.replace(keys, image_size=0) != Keys():
            raise ValueError(f"{where} has the dataset's options: change them there")
        where, keys = dataset_file.read(where, keys.image_size if keys else 0)
    path = hub.local(where, repository="dataset")
    if (path / "meta" / "info.json").is_file():
        return LeRobot(path, keys, name=name, cameras=cameras)
    keys = keys or Keys()
    if dataclasses.replace(keys, image_size=0, cameras={}) != Keys():
        raise ValueError(f"{where} is not a LeRobot dataset: --state, --angles etc. do not apply")
    for file, reader in ((HEADER, Cache), (rlds.METADATA, rlds.Reader)):
        if (path / file).is_file():
            if not keys.cameras:
                return reader(path, cameras)
            names, _ = choose_cameras(keys.cameras, cameras, path)
            return Renamed(reader(path, [*names.values()]), names)
    files = ("meta/info.json", rlds.METADATA, HEADER)
    inside = sorted(x for x in path.glob("*") if any((x / file).is_file() for file in files))
    raise ValueError(
        f"{where} is not a dataset: expected a folder with meta/info.json (LeRobot), "
        f"{rlds.METADATA} (RLDS, from python -m envs collect) or {HEADER} (cache)"
        + (f", such as {inside[0]}" if inside else "")
    )


def _real(where: str) -> str:
    """Return where the dataset is; two files may name one."""
    path = dataset_file.read(where, 0)[0] if dataset_file.is_file(where) else where
    return path if hub.is_remote(path) else os.path.realpath(path)


def _name(where: str | os.PathLike[str]) -> str:
    return Path(where).stem if dataset_file.is_file(where) else Path(where).name
