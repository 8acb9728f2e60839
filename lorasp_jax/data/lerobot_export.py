"""Export any dataset as LeRobot v3.0, with pictures as PNG columns; LeRobot is not needed.

The layout is that of `LeRobotDataset` in LeRobot 0.6.1 (`src/lerobot/datasets`), with one file of
rows per episode.
"""

import io
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from envs.datasets.episodes import Episodes, joint_names, labelled
from lorasp_jax.base.locks import locked
from lorasp_jax.base.writing import atomic_folder, write_text
from lorasp_jax.data.lerobot_features import DONE, INTERVENTION, SUCCESS
from lorasp_jax.data.source import Progress, Source, dimension_names
from lorasp_jax.policies import statistics_files

_FILES_PER_CHUNK = 1000
_ROWS = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_INDICES = ("frame_index", "episode_index", "index", "task_index")
_PICTURE = pa.struct({"bytes": pa.binary(), "path": pa.string()})
# Makes pandas, with which LeRobot reads this file, use the tasks as the index.
_TASK_INDEX = {
    "index_columns": ["task"],
    "column_indexes": [],
    "columns": [
        {"name": "task_index", "field_name": "task_index", "metadata": None}
        | {"pandas_type": "int64", "numpy_type": "int64"},
        {"name": "task", "field_name": "task", "metadata": None}
        | {"pandas_type": "unicode", "numpy_type": "object"},
    ],
    "pandas_version": "2.0.0",
}


def to_lerobot(source: Source, path: str | os.PathLike[str], progress: Progress) -> None:
    """Write a LeRobot folder, which appears only once it is complete.

    Args:
        source: a dataset; not modified. Instructions become LeRobot's tasks.
        path: folder to create.
        progress: called with the steps done and the total.

    Raises:
        ValueError: the path already exists, another process is writing it, the frame rate is not a
            whole number, or metadata differs between episodes.
        OSError: the disk is full.
    """
    with locked(Path(path)), atomic_folder(path) as folder:
        writer = _Writer(folder, source.control_dt, dimension_names(source))
        numbers = range(len(source))
        labels = {name for number in numbers for name in source.episode(number, ()).labels}
        for number in numbers:
            writer.append(labelled(source.episode(number), labels))
            progress(writer.steps, source.num_steps)
        writer.complete()


class _Writer:
    """Writes one episode at a time and keeps the metadata of all."""

    def __init__(self, folder: Path, control_dt: float, names: dict[str, list[str]]) -> None:
        self.folder, self.fps, self.steps = folder, round(1 / control_dt), 0
        self._names = names
        if abs(self.fps * control_dt - 1) > 1e-3:
            raise ValueError(f"LeRobot needs whole frames per second, got {1 / control_dt:g}")
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._features: dict[str, Any] = {}
        self._robot = ""
        self._statistics: dict[str, list[dict[str, Any]]] = {}

    def append(self, episode: Episodes) -> None:
        number, length = len(self._episodes), int(episode.length[0])
        features = _features(episode, self._names)
        if number and (features, episode.robot) != (self._features, self._robot):
            raise ValueError(f"episode {number} has another robot or other shapes than the first")
        self._features, self._robot = features, episode.robot
        task = episode.phrases[0]
        arrays = {
            "observation.state": np.asarray(episode.state[0, :length]),
            "action": np.asarray(episode.action[0, :length]),
            **{_key(c): np.asarray(images[0, :length]) for c, images in episode.image.items()},
            **_marks(episode, length),
            "timestamp": (np.arange(length) / self.fps).astype(np.float32),
            "frame_index": np.arange(length),
            "episode_index": np.full(length, number),
            "index": self.steps + np.arange(length),
            "task_index": np.full(length, self._tasks.setdefault(task, len(self._tasks))),
        }
        for name, array in arrays.items():
            self._statistics.setdefault(name, []).append(_statistics(array))
        chunk, file = divmod(number, _FILES_PER_CHUNK)
        rows = self.folder / _ROWS.format(chunk_index=chunk, file_index=file)
        _write_table(rows, {name: _column(array) for name, array in arrays.items()})
        self._episodes.append(
            {"episode_index": number, "tasks": [task], "length": length}
            | {"data/chunk_index": chunk, "data/file_index": file}
            | {"dataset_from_index": self.steps, "dataset_to_index": self.steps + length}
            | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        )
        self.steps += length

    def complete(self) -> None:
        meta = self.folder / "meta"
        episodes = {name: [e[name] for e in self._episodes] for name in self._episodes[0]}
        _write_table(meta / "episodes" / "chunk-000" / "file-000.parquet", episodes)
        tasks = {"task_index": list(self._tasks.values()), "task": list(self._tasks)}
        _write_table(meta / "tasks.parquet", tasks, {"pandas": json.dumps(_TASK_INDEX)})
        write_text(meta / "stats.json", json.dumps(self._all_statistics(), indent=2))
        info = {
            "codebase_version": "v3.0",
            "robot_type": self._robot,
            "fps": self.fps,
            "total_episodes": len(self._episodes),
            "total_frames": self.steps,
            "total_tasks": len(self._tasks),
            "chunks_size": _FILES_PER_CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": _ROWS,
            "video_path": None,
            "features": self._features,
        }
        write_text(meta / "info.json", json.dumps(info, indent=2))

    def _all_statistics(self) -> dict[str, Any]:
        """Return the dataset's statistics; those of pictures have shape `[3, 1, 1]`."""
        stats = {}
        for name, episodes in self._statistics.items():
            shape = (3, 1, 1) if name.startswith(_key("")) else (-1,)
            found = statistics_files.aggregate(episodes)
            stats[name] = {key: value.reshape(shape).tolist() for key, value in found.items()}
            stats[name]["count"] = [self.steps]
        return stats


def _statistics(array: np.ndarray) -> dict[str, Any]:
    """Return an episode's statistics, of pictures `[T, H, W, 3]` by channel and in [0, 1]."""
    width = array.shape[-1] if array.ndim > 1 else 1
    rows = array.reshape(-1, width).astype(np.float64) / (255 if array.ndim == 4 else 1)
    moments = {"mean": rows.mean(0), "std": rows.std(0), "min": rows.min(0), "max": rows.max(0)}
    return moments | {"count": [len(array)]}


def _features(episode: Episodes, names: dict[str, list[str]]) -> dict[str, Any]:
    own = [*joint_names(episode.state.shape[2] - 1), "gripper"]
    joints = names.get("state") or [f"{name}.pos" for name in own]  # as LeRobot's arms have it
    same = episode.actions == "joint" and episode.action.shape[2] == len(joints)
    actions = names.get("action") or (joints if same else None)
    features: dict[str, Any] = {
        "observation.state": {"dtype": "float32", "shape": [len(joints)], "names": joints},
        "action": {"dtype": "float32", "shape": [episode.action.shape[2]], "names": actions},
    }
    axes = ["height", "width", "channels"]
    for camera, images in episode.image.items():
        features[_key(camera)] = {"dtype": "image", "shape": [*images.shape[2:]], "names": axes}
    features |= {
        name: {"dtype": "bool", "shape": [1], "names": None} for name in _marks(episode, 1)
    }
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    return features | {name: {"dtype": "int64", "shape": [1], "names": None} for name in _INDICES}


def _marks(episode: Episodes, length: int) -> dict[str, np.ndarray]:
    """Return the columns of success and corrections; an unknown outcome is one that is not done."""
    marks: dict[str, np.ndarray] = {}
    if episode.success is not None:
        last, success = np.arange(length) == length - 1, int(episode.success[0])
        marks = {SUCCESS: last & (success == 1), DONE: last & (success >= 0)}
    if episode.corrected is not None:
        marks[INTERVENTION] = np.asarray(episode.corrected[0, :length])
    return marks


def _key(camera: str) -> str:
    return f"observation.images.{camera}"


def _column(array: np.ndarray) -> pa.Array:
    if array.ndim == 4:
        return pa.array([{"bytes": _png(image), "path": None} for image in array], _PICTURE)
    if array.ndim == 2:
        flat = pa.array(array.ravel().astype(np.float32))
        return pa.FixedSizeListArray.from_arrays(flat, array.shape[1])
    return pa.array(array)


def _png(image: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(image).save(file, "png")
    return file.getvalue()


def _write_table(
    path: Path, columns: dict[str, Any], metadata: dict[str, str] | None = None
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    table = pa.table(columns)
    pq.write_table(table.replace_schema_metadata(metadata) if metadata else table, path)
