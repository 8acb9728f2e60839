"""Read LeRobot datasets, versions 2.0, 2.1 and 3.0, without lerobot or torch.

    dataset = LeRobot("hf://lerobot/some_dataset", Keys(angles="degrees", gripper="millimetres"))
    episodes = dataset.episode(0)

States and actions are columns of parquet files. Images are video frames, or PNG or JPEG files
that other columns contain or name. Each episode is returned as `Episodes` with E = 1, in this
project's order and units.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from envs.datasets.episodes import Episodes, check_camera, choose_cameras, full_name
from lorasp_jax.base import hub
from lorasp_jax.base.files import (
    RefusedError,
    check_memory,
    check_regular,
    join_inside,
    read_bytes,
)
from lorasp_jax.data import lerobot_features
from lorasp_jax.data.keys import Keys
from lorasp_jax.data.lerobot_features import DONE, SUCCESS
from lorasp_jax.data.lerobot_files import (
    EpisodeEntry,
    Index,
    as_value_error,
    read_index,
    read_table,
)
from lorasp_jax.data.video import VideoReader, check_same_size, decode_image

_COLUMNS = ("timestamp", "frame_index", "episode_index", "task_index")
_TIME_TOLERANCE = 0.25
"""Tolerance of timestamps, in frame periods, as for videos."""
_PICTURES = (pa.types.is_struct, pa.types.is_binary, pa.types.is_large_binary)
"""Types of columns that may contain PNG or JPEG files, or name them."""


class LeRobot:
    """A LeRobot dataset.

    Attributes:
        kind: name and version of the format.
        name: name of the dataset.
        path: folder of the dataset.
        index: metadata of the dataset.
        keys: feature mapping.
        cameras: camera -> feature.
        left_out: picture -> why it is not among the cameras.
        control_dt: time between two steps [s].
        names: "state" and "action" -> names of the selected dimensions, in order; their indices if
            the dataset has no names.
        grippers: "state" and "action" -> which of these are grippers.
    """

    def __init__(
        self,
        source: str | os.PathLike[str],
        keys: Keys | None = None,
        *,
        name: str = "",
        cameras: Sequence[str] = (),
    ) -> None:
        """Open a dataset.

        Args:
            source: a folder, or hf://owner/name, which is downloaded from the Hub.
            keys: feature mapping; None uses LeRobot's usual names.
            name: name of the dataset; if empty, that of the folder or repository.
            cameras: names of the cameras to use; empty: all.

        Raises:
            ValueError: the dataset is missing or damaged, or lacks a feature named in `keys`.
        """
        self.path: Path = hub.local(source, repository="dataset")
        self.index: Index = read_index(self.path)
        self.keys: Keys = keys or Keys()
        self.kind: str = f"LeRobot {self.index.version}"
        self.name: str = name or Path(source).name
        self.cameras: dict[str, str]
        self.left_out: dict[str, str]
        self.cameras, self.left_out = self._choose_cameras(cameras)
        self.control_dt: float = self.keys.every / self.index.fps
        self._sizes: dict[str, int] = {}
        self._columns: dict[str, list[int]] = {}
        self.names: dict[str, list[str]] = {}
        self._select_dimensions()
        self.grippers: dict[str, list[int]] = {
            kind: self._select_grippers(kind) for kind in self.names
        }
        images = [key for key in self.cameras.values() if not self._is_video(key)]
        needed = (self.keys.state, self.keys.action, *_COLUMNS, *images)
        self._marks: list[str] = lerobot_features.marks(self.index.features)
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
            **self._labels(table, entry),
        )
        with as_value_error(Path(f"{entry.table}: episode {entry.number}")):
            episode.validate_numbers()
        return episode

    def _choose_cameras(self, chosen: Sequence[str]) -> tuple[dict[str, str], dict[str, str]]:
        """Return `cameras` and `left_out`."""
        with as_value_error(self._info):
            pictures, reasons = lerobot_features.pictures(self.index.features)
        given = {n: full_name(key, pictures.values()) for n, key in self.keys.cameras.items()}
        selected = given or pictures
        known = [key for key in pictures.values() if key not in reasons]
        if wrong := [key for key in given.values() if key not in known]:
            why = f", it is marked as {reasons[wrong[0]]}" if wrong[0] in reasons else ""
            raise ValueError(
                f"{self.path} has no color camera {wrong[0]}{why}: choose from {', '.join(known)}"
            )
        usable = {name: key for name, key in selected.items() if key in known}
        others = {name: reasons[key] for name, key in pictures.items() if key in reasons}
        cameras, left_out = choose_cameras(usable, chosen, self.path, others)
        for name, key in cameras.items():
            try:
                check_camera(name)
            except ValueError as error:
                raise ValueError(
                    f"{self.path}: {error}; rename it with python -m lorasp_jax.data convert "
                    f"--cameras NAME={key}"
                ) from None
        return cameras, left_out

    @property
    def _info(self) -> Path:
        return self.path / "meta" / "info.json"

    def _is_video(self, key: str) -> bool:
        return self.index.features[key]["dtype"] == "video"

    def _select_dimensions(self) -> None:
        """Select those of state and action, in the same order if they are the same."""
        for kind in ("state", "action"):
            key, wanted = getattr(self.keys, kind), getattr(self.keys, f"{kind}_numbers")
            with as_value_error(self._info):
                names = lerobot_features.dimension_names(self.index.features, key, self._info)
            columns = lerobot_features.select(names, wanted, f"{self.path}: {kind}")
            self._sizes[kind], self._columns[kind] = len(names), columns
            self.names[kind] = [names[column] for column in columns]
        state, action = self.names["state"], self.names["action"]
        if state != action and sorted(state) == sorted(action):
            raise ValueError(
                f"{self.path} has another order in state than in action, {self.names}: choose one "
                "order with --state-numbers and --action-numbers"
            )

    def _select_grippers(self, kind: str) -> list[int]:
        """Return which of the selected dimensions of state or action are grippers."""
        if not self.keys.grippers:
            return lerobot_features.grippers(self.names[kind])
        what = f"{self.path}: the selected {kind}"
        return lerobot_features.select(self.names[kind], self.keys.grippers, what)

    def _frames(self, entry: EpisodeEntry) -> Any:
        """Read the episode's rows from its parquet file; check frame numbers and timestamps."""
        path, number = entry.table, entry.number
        with as_value_error(path):
            if self._table[0] != path:
                self._table = path, read_table(path, self.path, self._needed, optional=self._marks)
            table = self._table[1]
            of_episode = lerobot_features.rows(table["episode_index"], 1)[:, 0] == number
            table = table.filter(pa.array(of_episode))
            frames, times = (
                lerobot_features.rows(table[name], 1)[:, 0] for name in ("frame_index", "timestamp")
            )
            if len(frames) != entry.length or np.any(frames != np.arange(len(frames))):
                raise ValueError(f"episode {number} must have frames 0 to {entry.length - 1}")
            drift = np.abs(times - frames / self.index.fps) * self.index.fps
            if not np.all(drift <= _TIME_TOLERANCE):
                if np.ptp(drift) <= _TIME_TOLERANCE:
                    raise RefusedError(
                        f"{path}: episode {number} begins at the timestamp {times[0]:g} s, but the "
                        "timestamps of each episode must begin at 0"
                    )
                raise ValueError(f"episode {number} does not have {self.index.fps:g} fps")
        return table

    def _values(self, table: Any, entry: EpisodeEntry, kind: str) -> np.ndarray:
        """Return joints [rad] and gripper [m], f32 `[T, J+1]`."""
        key, columns = getattr(self.keys, kind), self._columns[kind]
        with as_value_error(entry.table):
            try:
                values = lerobot_features.rows(table[key], self._sizes[kind])[:, columns]
            except ValueError as error:
                raise ValueError(f"{key} of episode {entry.number}: {error}") from error
        is_gripper = np.isin(np.arange(len(columns)), self.grippers[kind])
        angle = np.deg2rad(1) if self.keys.angles == "degrees" else 1
        length = 1e-3 if self.keys.gripper == "millimetres" else 1
        values = values * np.where(is_gripper, length, angle)
        steps = self._selected(len(values), kind)
        with np.errstate(over="ignore"):  # overflows to inf, which is rejected later
            return values[steps].astype(np.float32)

    def _selected(self, length: int, kind: str) -> np.ndarray:
        """Return the frames that states or actions are taken from, of an episode's `length`."""
        every = self.keys.every
        # Each selected state is paired with the last action before the next selected state.
        first = 0 if kind == "state" else every - 1
        return np.minimum(np.arange(0, length, every) + first, length - 1)

    def _labels(self, table: Any, entry: EpisodeEntry) -> dict[str, Any]:
        """Return `Episodes.success` and `corrected`, those that the dataset has."""
        present = [name for name in self._marks if name in table.column_names]
        with as_value_error(entry.table):  # null is read as NaN
            marks = {name: lerobot_features.rows(table[name], 1)[:, 0] for name in present}
        done, success = marks.pop(DONE, np.ones(1)), marks.pop(SUCCESS, None)
        labels: dict[str, Any] = {}
        if success is not None:
            failed = 0 if success[-1] >= 0 and done[-1] > 0 else -1  # cut off or not said: unknown
            labels["success"] = np.array([1 if (success > 0).any() else failed], np.int32)
        if marks:
            steps = self._selected(entry.length, "action")
            labels["corrected"] = np.any([x[steps] > 0 for x in marks.values()], axis=0)[None]
        return labels

    def _instruction(self, table: Any, entry: EpisodeEntry) -> int:
        """Return the index of the episode's instruction in `Episodes.instructions`."""
        with as_value_error(entry.table):
            tasks = np.unique(lerobot_features.rows(table["task_index"], 1))
            known = sorted(self.index.tasks)
            if len(tasks) > 1 or tasks[0] not in known:
                raise RefusedError(
                    f"{entry.table}: episode {entry.number} must have one of the tasks {known}, "
                    f"got {tasks}"
                )
            return known.index(int(tasks[0]))

    def _images(self, table: Any, entry: EpisodeEntry, camera: str) -> np.ndarray:
        """Load the images of the selected frames, uint8 `[T, H, W, 3]`."""
        key, every, size = self.cameras[camera], self.keys.every, self.keys.image_size
        if self._is_video(key):
            path, start = entry.videos[key]
            video = self._video(camera, path)
            fps, length = self.index.fps, entry.length
            return video.read(start, length, fps, every=every, image_size=size)
        what = f"{entry.table}: a picture of {key}"
        with as_value_error(entry.table):
            column = table[key]
            if not any(is_type(column.type) for is_type in _PICTURES):
                raise RefusedError(f"{what} is {column.type}, neither a PNG nor a JPEG file")
            # Read one by one, because rows may name files in place of containing them.
            files = (self._file(row, what) for row in column.to_pylist()[::every])
            first = decode_image(next(files), what, size)
            length = -(-entry.length // every)
            check_memory(length * first.nbytes, f"an episode in {entry.table}")
            images = [first, *(decode_image(file, what, size) for file in files)]
            for image in images:
                check_same_size(image, first, entry.table)
            return np.stack(images)

    def _file(self, row: Any, what: str) -> bytes:
        """Return the content of a picture file that a row contains, or names by its path."""
        content, name = (
            (row.get("bytes"), row.get("path")) if isinstance(row, dict) else (row, None)
        )
        if content is None and name is None:
            raise RefusedError(f"{what} is missing")
        if content is not None and not isinstance(content, bytes):
            raise RefusedError(f"{what} must be bytes, got {type(content).__name__}")
        return read_bytes(join_inside(self.path, name), self.path) if content is None else content

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
