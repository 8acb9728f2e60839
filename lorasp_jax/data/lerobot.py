"""Read LeRobot datasets, versions 2.0, 2.1 and 3.0, without lerobot or torch.

    dataset = LeRobot("hf://lerobot/some_dataset", Keys(angles="degrees", gripper="millimetres"))
    episodes = dataset.episode(0)

States and actions are columns of parquet files. Images are video frames, or PNG or JPEG files in
other columns. Each episode is returned as `Episodes` with E = 1, in this project's order and units.
"""

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from envs.datasets.episodes import Episodes
from lorasp_jax.base import hub
from lorasp_jax.base.files import as_int, check_memory, check_regular
from lorasp_jax.data.keys import Keys
from lorasp_jax.data.lerobot_files import (
    EpisodeEntry,
    Index,
    as_value_error,
    read_index,
    read_table,
)
from lorasp_jax.data.video import VideoReader, decode_image

_COLUMNS = ("timestamp", "frame_index", "episode_index", "task_index")
_MAX_DIM = 10_000  # limit for state and action
_TIME_TOLERANCE = 0.25
"""Tolerance of timestamps, in frame periods, as for videos."""


class LeRobot:
    """A LeRobot dataset.

    Attributes:
        kind: name and version of the format.
        name: name of the dataset.
        path: folder of the dataset.
        index: metadata of the dataset.
        keys: feature mapping.
        cameras: camera -> feature.
        control_dt: time between two steps [s].
        names: "state" and "action" -> names of the selected dimensions, in order; their indices if
            the dataset has no names.
    """

    def __init__(
        self, source: str | os.PathLike[str], keys: Keys | None = None, *, name: str = ""
    ) -> None:
        """Open a dataset.

        Args:
            source: a folder, or hf://owner/name, which is downloaded from the Hub.
            keys: feature mapping; None uses LeRobot's usual names.
            name: name of the dataset; if empty, that of the folder or repository.

        Raises:
            ValueError: the dataset is missing or damaged, or lacks a feature named in `keys`.
        """
        self.path: Path = hub.local(source, repository="dataset")
        self.index: Index = read_index(self.path)
        self.keys: Keys = keys or Keys()
        self.kind: str = f"LeRobot {self.index.version}"
        self.name: str = name or Path(source).name
        self.cameras: dict[str, str] = self._cameras()
        self.control_dt: float = self.keys.every / self.index.fps
        self._columns = {"state": self._selection("state"), "action": self._selection("action")}
        self.names: dict[str, list[str]] = {
            kind: [self._names(kind)[column] for column in columns]
            for kind, columns in self._columns.items()
        }
        if len(self.names["state"]) != len(self.names["action"]):
            raise ValueError(
                f"{self.path} has other dimensions in state than in action, {self.names}: choose "
                "the same joints and gripper with --state-numbers and --action-numbers"
            )
        images = [key for key in self.cameras.values() if not self._is_video(key)]
        needed = (self.keys.state, self.keys.action, *_COLUMNS, *images)
        self._needed = list(dict.fromkeys(needed))  # state and action may be the same feature
        self._videos: dict[str, VideoReader] = {}
        self._table: tuple[Path | None, Any] = None, None

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.index.episodes)

    @property
    def num_steps(self) -> int:
        """Total number of control steps."""
        return sum(-(-entry.length // self.keys.every) for entry in self.index.episodes)

    def episode(self, number: int, cameras: Sequence[str] | None = None) -> Episodes:
        """Load one episode into host memory.

        Args:
            number: index of the episode.
            cameras: cameras to load, or None for all.

        Raises:
            ValueError: the episode is damaged, or does not match the metadata.
        """
        entry = self.index.episodes[number]
        table = self._frames(entry)
        state, action = (self._values(table, entry, kind) for kind in ("state", "action"))
        selected = self.cameras if cameras is None else cameras
        with ThreadPoolExecutor() as pool:
            images = list(pool.map(lambda name: self._images(table, entry, name), selected))
        episode = Episodes(
            image={name: x[None] for name, x in zip(selected, images, strict=True)},
            state=state[None],
            action=action[None],
            length=np.array([len(state)], np.int32),
            instruction=np.array([self._instruction(table, entry)], np.int32),
            instructions=tuple(self.index.tasks[i] for i in sorted(self.index.tasks)),
            task=self.name,
            robot=self.index.robot,
            control_dt=self.control_dt,
            physics_dt=0.0,
            attempted=1,
        )
        with as_value_error(entry.table):
            episode.validate_numbers()
        return episode

    def _cameras(self) -> dict[str, str]:
        available = {
            key.removeprefix("observation.").removeprefix("images."): key
            for key, feature in self.index.features.items()
            if feature["dtype"] in ("video", "image")
        }
        selected = dict(self.keys.cameras) or available
        if not selected or not set(selected.values()) <= set(available.values()):
            raise ValueError(f"{self.path} has the cameras {available}, at least one is needed")
        return selected

    def _is_video(self, key: str) -> bool:
        return self.index.features[key]["dtype"] == "video"

    def _names(self, kind: str) -> list[str]:
        """Return the names of a feature's dimensions, or their indices if they are unnamed."""
        key = getattr(self.keys, kind)
        with as_value_error(self.path / "meta" / "info.json"):
            feature = self.index.features[key]
            (dim,) = map(as_int, feature["shape"])
            if not 0 < dim <= _MAX_DIM:
                raise ValueError(f"{key} has {dim} dimensions")
            names = feature.get("names")
            while isinstance(names, Mapping):  # {"motors": [...]}
                names = next(iter(names.values()), None)
        if isinstance(names, list) and len(names) == dim:
            return [str(name) for name in names]
        return [str(i) for i in range(dim)]

    def _selection(self, kind: str) -> list[int]:
        """Return the indices of the selected dimensions of a feature."""
        names = self._names(kind)
        selected = getattr(self.keys, f"{kind}_numbers") or [str(i) for i in range(len(names))]
        by_name = {str(i): i for i in range(len(names))} | {n: i for i, n in enumerate(names)}
        if unknown := [name for name in selected if name not in by_name]:
            raise ValueError(f"{self.path} has no {kind} {unknown[0]}: choose from {[*by_name]}")
        return [by_name[name] for name in selected]

    def _frames(self, entry: EpisodeEntry) -> Any:
        """Read the episode's rows from its parquet file; check frame numbers and timestamps."""
        path, number = entry.table, entry.number
        with as_value_error(path):
            if self._table[0] != path:
                self._table = path, read_table(path, self.path, self._needed)
            table = self._table[1]
            table = table.filter(pc.equal(table["episode_index"], number))
            frames = table["frame_index"].cast(pa.int64()).to_numpy()
            times = table["timestamp"].cast(pa.float64()).to_numpy()
            if len(frames) != entry.length or np.any(frames != np.arange(len(frames))):
                raise ValueError(f"episode {number} must have frames 0 to {entry.length - 1}")
            drift = np.abs(times - frames / self.index.fps) * self.index.fps
            if not np.all(drift <= _TIME_TOLERANCE):
                raise ValueError(f"episode {number} does not have {self.index.fps:g} fps")
        return table

    def _values(self, table: Any, entry: EpisodeEntry, kind: str) -> np.ndarray:
        """Return joints [rad] and gripper [m], f32 `[T, J+1]`."""
        key, path = getattr(self.keys, kind), entry.table
        with as_value_error(path):
            column = table[key].combine_chunks()
            dim = len(self._names(kind))
            dims = set(pc.list_value_length(column).to_pylist())
            values = column.flatten().cast(pa.float64()).to_numpy(zero_copy_only=False)
            if dims != {dim}:
                raise ValueError(f"episode {entry.number} must have {dim} dimensions in {key}")
        values = values.reshape(-1, dim)[:, self._columns[kind]]
        if self.keys.angles == "degrees":
            values = np.concatenate([np.deg2rad(values[:, :-1]), values[:, -1:]], axis=1)
        if self.keys.gripper == "millimetres":
            values = np.concatenate([values[:, :-1], values[:, -1:] / 1000], axis=1)
        every = self.keys.every
        # Each selected state is paired with the last action before the next selected state.
        first = 0 if kind == "state" else every - 1
        steps = np.minimum(np.arange(0, len(values), every) + first, len(values) - 1)
        return values[steps].astype(np.float32)

    def _instruction(self, table: Any, entry: EpisodeEntry) -> int:
        """Return the index of the episode's instruction in `Episodes.instructions`."""
        with as_value_error(entry.table):
            (task,) = pc.unique(table["task_index"]).to_pylist()
            return sorted(self.index.tasks).index(task)

    def _images(self, table: Any, entry: EpisodeEntry, camera: str) -> np.ndarray:
        """Load the images of the selected frames, uint8 `[T, H, W, 3]`."""
        key, every, size = self.cameras[camera], self.keys.every, self.keys.image_size
        if self._is_video(key):
            path, start = entry.videos[key]
            video = self._video(camera, path)
            fps, length = self.index.fps, entry.length
            return video.read(start, length, fps, every=every, image_size=size)
        with as_value_error(entry.table):
            files = [row["bytes"] for row in table[key].to_pylist()[::every]]
            first = decode_image(files[0], size)
            check_memory(len(files) * first.nbytes, f"an episode in {entry.table}")
            return np.stack([first, *(decode_image(file, size) for file in files[1:])])

    def _video(self, camera: str, path: Path) -> VideoReader:
        """Return a camera's video, left open because the next episode may be in the same file."""
        video = self._videos.get(camera)
        if video is None or video.path != path:
            if video is not None:
                video.close()
            with as_value_error(path):
                check_regular(path, self.path)
            video = self._videos[camera] = VideoReader(path)
        return video
