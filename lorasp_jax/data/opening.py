"""Datasets of every kind that is known, told apart by what lies in their folder."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

from envs.datasets import rlds
from envs.datasets.episodes import Episodes
from lorasp_jax.data.cache import HEADER, Cache
from lorasp_jax.data.lerobot import Keys, LeRobot
from lorasp_jax.data.lerobot_files import is_lerobot
from lorasp_jax.data.source import Source
from lorasp_jax.storage import hub


def open_source(where: str | os.PathLike[str], keys: Keys | None = None) -> Source:
    """A dataset of LeRobot or RLDS, a cache, or a file of episodes.

    Args:
        where: a path, or hf://owner/name of a LeRobot dataset on the hub.
        keys: what is what in a LeRobot dataset; the others say it themselves.

    Raises:
        ValueError: it is not there, is of no known kind, or is damaged; or keys for another kind.
    """
    path = hub.local(where, repository="dataset")
    if is_lerobot(path):
        return LeRobot(path, keys, name=Path(where).name)
    if keys and dataclasses.replace(keys, image_size=0) != Keys():
        raise ValueError(f"{where} is no LeRobot dataset: it says itself which numbers are what")
    if (path / HEADER).is_file():
        return Cache(path)
    if (path / rlds.METADATA).is_file():
        return rlds.Reader(path)
    if path.suffix == ".npz":
        return _File(path)
    raise ValueError(
        f"{where} is no dataset: it has neither meta/info.json (LeRobot) nor {rlds.METADATA} "
        f"(RLDS, of python -m envs collect) nor {HEADER} (a cache), and is no .npz file"
    )


class _File:
    """Episodes in an .npz file, see `Episodes.save`."""

    kind = "npz"

    def __init__(self, path: Path) -> None:
        self._episodes = Episodes.load(path)
        self.cameras = tuple(self._episodes.image)
        self.control_dt, self.num_steps = self._episodes.control_dt, self._episodes.num_steps

    def __len__(self) -> int:
        return self._episodes.num_episodes

    def episode(self, number: int, cameras: Sequence[str] | None = None) -> Episodes:
        names = self.cameras if cameras is None else cameras
        image = {name: self._episodes.image[name] for name in names}
        one = dataclasses.replace(self._episodes, image=image, attempted=1).select([number])
        length = int(one.length[0])
        short = {name: picture[:, :length] for name, picture in one.image.items()}
        return dataclasses.replace(
            one, image=short, state=one.state[:, :length], action=one.action[:, :length]
        )
