"""Datasets of LeRobot, versions 2.0, 2.1 and 3.0, without LeRobot and without torch.

    dataset = LeRobot("hf://lerobot/some_dataset", Keys(angles="degrees", gripper="millimetres"))
    episodes = dataset.episode(0)

Numbers are columns of parquet files, pictures are frames of videos or PNG in such columns. An
episode comes as `Episodes` with one episode in it, in this project's order and units.
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
from envs.datasets.files import check_memory, regular, whole
from lorasp_jax.data.keys import Keys
from lorasp_jax.data.lerobot_files import Index, Recording, damage, read_index, read_table
from lorasp_jax.data.video import Film, decoded
from lorasp_jax.storage import hub

_COLUMNS = ("timestamp", "frame_index", "episode_index", "task_index")
_WIDTH = 10_000  # numbers that a state or an action may have
_TIME = 0.25
"""Share of a frame's time by which a timestamp may be off, as of `films`."""


class LeRobot:
    """A LeRobot dataset.

    Attributes:
        kind: the format's name and version.
        name: what it is called.
        path: its folder.
        index: what it says of itself.
        keys: which of its features are what.
        cameras: name here -> feature.
        control_dt: time between two steps [s].
        names: "state" and "action" -> what its numbers are called, in order; an index where they
            have no names.
    """

    def __init__(
        self, where: str | os.PathLike[str], keys: Keys | None = None, *, name: str = ""
    ) -> None:
        """Opens a dataset.

        Args:
            where: a folder, or hf://owner/name, which is fetched from the hub.
            keys: which of its features are what.
            name: what it is called; empty: what the folder or the repository is.

        Raises:
            ValueError: it is not there, damaged, or lacks a feature that the keys name.
        """
        self.path: Path = hub.local(where, repository="dataset")
        self.index: Index = read_index(self.path)
        self.keys: Keys = keys or Keys()
        self.kind: str = f"LeRobot {self.index.version}"
        self.name: str = name or Path(where).name
        self.cameras: dict[str, str] = self._cameras()
        self.control_dt: float = self.keys.every / self.index.fps
        self._columns = {"state": self._chosen("state"), "action": self._chosen("action")}
        self.names: dict[str, list[str]] = {
            kind: [self._names(kind)[column] for column in columns]
            for kind, columns in self._columns.items()
        }
        if len(set(map(len, self._columns.values()))) > 1:
            widths = " and ".join(f"{len(c)} for {name}" for name, c in self._columns.items())
            raise ValueError(
                f"state and action need as many numbers, joints and gripper, but {self.path} has "
                f"{widths}: choose state_numbers among {', '.join(self._names('state'))} and "
                f"action_numbers among {', '.join(self._names('action'))}"
            )
        pictures = [key for key in self.cameras.values() if not self._is_film(key)]
        needed = (self.keys.state, self.keys.action, *_COLUMNS, *pictures)
        self._needed = list(dict.fromkeys(needed))  # state and action may be the same
        self._films: dict[str, Film] = {}
        self._table: tuple[Path | None, Any] = None, None

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.index.recordings)

    @property
    def num_steps(self) -> int:
        """Control steps of all episodes."""
        return sum(-(-recording.length // self.keys.every) for recording in self.index.recordings)

    def episode(self, number: int, cameras: Sequence[str] | None = None) -> Episodes:
        """One episode, in host memory.

        Args:
            number: which.
            cameras: those whose pictures are wanted; None: all.

        Raises:
            ValueError: it is damaged, or not what the dataset says.
        """
        recording = self.index.recordings[number]
        table = self._rows(recording)
        state, action = (self._numbers(table, recording, kind) for kind in ("state", "action"))
        wanted = self.cameras if cameras is None else cameras
        with ThreadPoolExecutor() as pool:
            pictures = list(pool.map(lambda name: self._pictures(table, recording, name), wanted))
        episodes = Episodes(
            image={name: p[None] for name, p in zip(wanted, pictures, strict=True)},
            state=state[None],
            action=action[None],
            length=np.array([len(state)], np.int32),
            instruction=np.array([self._instruction(table, recording)], np.int32),
            instructions=tuple(self.index.tasks[i] for i in sorted(self.index.tasks)),
            task=self.name,
            robot=self.index.robot,
            control_dt=self.control_dt,
            physics_dt=0.0,
            attempted=1,
        )
        try:
            episodes.validate_numbers()
        except ValueError as error:
            raise ValueError(f"episode {recording.number} of {self.path}: {error}") from error
        return episodes

    def _cameras(self) -> dict[str, str]:
        """Name -> feature of all cameras that are wanted."""
        there = {
            key.removeprefix("observation.").removeprefix("images."): key
            for key, feature in self.index.features.items()
            if feature["dtype"] in ("video", "image")
        }
        wanted = dict(self.keys.cameras) or there
        unknown = sorted(set(wanted.values()) - set(there.values()))
        if unknown or not wanted:
            raise ValueError(
                f"{self.path} has no pictures {', '.join(unknown) or 'at all'}; "
                f"there are {', '.join(there.values()) or 'none'}"
            )
        return wanted

    def _is_film(self, key: str) -> bool:
        return self.index.features[key]["dtype"] == "video"

    def _names(self, kind: str) -> list[str]:
        """What a feature's numbers are called; their indices where they have no names."""
        key = getattr(self.keys, kind)
        with damage(self.path / "meta" / "info.json"):
            feature = self.index.features[key]
            (width,) = map(whole, feature["shape"])
            if not 0 < width <= _WIDTH:
                raise ValueError(f"{key} has {width} numbers, not 1 to {_WIDTH}")
            names = feature.get("names")
            while isinstance(names, Mapping):  # {"motors": [...]}
                names = next(iter(names.values()), None)
        if isinstance(names, list) and len(names) == width:
            return [str(name) for name in names]
        return [str(i) for i in range(width)]

    def _chosen(self, kind: str) -> list[int]:
        """Indices of the numbers that are wanted of a feature."""
        names = self._names(kind)
        wanted = getattr(self.keys, f"{kind}_numbers") or [str(i) for i in range(len(names))]
        by_name = {str(i): i for i in range(len(names))} | {n: i for i, n in enumerate(names)}
        unknown = [name for name in wanted if name not in by_name]
        if unknown:
            raise ValueError(
                f"{self.path} has no {', '.join(unknown)} in its {kind}, but "
                f"{', '.join(names)}, or 0 to {len(names) - 1}"
            )
        return [by_name[name] for name in wanted]

    def _rows(self, recording: Recording) -> Any:
        """The episode's rows of its parquet file, in order and complete."""
        path, number = recording.rows, recording.number
        with damage(path):
            if self._table[0] != path:
                self._table = path, read_table(path, self.path, self._needed)
            table = self._table[1]
            table = table.filter(pc.equal(table["episode_index"], number))
            frames = table["frame_index"].cast(pa.int64()).to_numpy()
            times = table["timestamp"].cast(pa.float64()).to_numpy()
        if len(frames) != recording.length or np.any(frames != np.arange(recording.length)):
            raise ValueError(
                f"{path} must have frames 0 to {recording.length - 1} of episode {number} in "
                f"order, but has {len(frames)}"
            )
        late = np.abs(times - frames / self.index.fps) * self.index.fps
        if not np.all(late <= _TIME):
            frame = int(np.argmax(~(late <= _TIME)))
            raise ValueError(
                f"{path} has frame {frame} of episode {number} at {times[frame]:.3f} s: that is "
                f"not the rate of {self.index.fps:g} frames a second in meta/info.json"
            )
        return table

    def _numbers(self, table: Any, recording: Recording, kind: str) -> np.ndarray:
        """f32 `[T, J+1]` joints [rad] and gripper [m]."""
        key, path = getattr(self.keys, kind), recording.rows
        with damage(path):
            column = table[key].combine_chunks()
            width = len(self._names(kind))
            widths = set(pc.list_value_length(column).to_pylist())
            values = column.flatten().cast(pa.float64()).to_numpy(zero_copy_only=False)
        if widths != {width}:
            raise ValueError(
                f"{path} has {sorted(map(str, widths))} numbers in {key} of episode "
                f"{recording.number}, not {width} as meta/info.json says"
            )
        chosen = values.reshape(-1, width)[:, self._columns[kind]]
        if self.keys.angles == "degrees":
            chosen = np.concatenate([np.deg2rad(chosen[:, :-1]), chosen[:, -1:]], axis=1)
        if self.keys.gripper == "millimetres":
            chosen = np.concatenate([chosen[:, :-1], chosen[:, -1:] / 1000], axis=1)
        every = self.keys.every
        # The action that was commanded last before the next step that counts.
        first = 0 if kind == "state" else every - 1
        steps = np.minimum(np.arange(0, len(chosen), every) + first, len(chosen) - 1)
        return chosen[steps].astype(np.float32)

    def _instruction(self, table: Any, recording: Recording) -> int:
        """Which instruction the episode follows, of the sorted ones."""
        with damage(recording.rows):
            found = pc.unique(table["task_index"]).to_pylist()
        if len(found) != 1 or found[0] not in self.index.tasks:
            raise ValueError(
                f"episode {recording.number} of {self.path} needs one task that meta lists, "
                f"not {str(found)[:80]}"
            )
        return sorted(self.index.tasks).index(found[0])

    def _pictures(self, table: Any, recording: Recording, camera: str) -> np.ndarray:
        """uint8 `[T, H, W, 3]` of the steps that count."""
        key, every, size = self.cameras[camera], self.keys.every, self.keys.image_size
        if self._is_film(key):
            path, start = recording.films[key]
            film = self._film(camera, path)
            fps, length = self.index.fps, recording.length
            pictures = film.read(start, length, fps, every=every, image_size=size)
        else:
            with damage(recording.rows):
                files = [row["bytes"] for row in table[key].to_pylist()[::every]]
                first = decoded(files[0], size)
                check_memory(len(files) * first.nbytes, f"an episode in {recording.rows}")
                pictures = np.stack([first, *(decoded(file, size) for file in files[1:])])
        return pictures

    def _film(self, camera: str, path: Path) -> Film:
        """The open file of a camera: many episodes may be in it."""
        film = self._films.get(camera)
        if film is None or film.path != path:
            if film is not None:
                film.close()
            with damage(path):
                regular(path, self.path)
            film = self._films[camera] = Film(path)
        return film
