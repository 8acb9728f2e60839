"""Write a LeRobot 3.0 dataset whose pictures are PNG files in its tables; needs pyarrow and Pillow.

Format: LeRobot, src/lerobot/datasets/utils.py, at 0.6.1.
"""

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

PICTURE = "observation.images.corner2"
AXES = {
    "observation.state": ["hand_x", "hand_y", "hand_z", "gripper"],
    "action": ["move_x", "move_y", "move_z", "gripper"],
}
FPS = 10
Recorded = tuple[Sequence[bytes], np.ndarray, np.ndarray]
"""PNG files, states `[T, 4]` and actions `[T, 4]` of an episode."""
COUNTERS = ("frame_index", "episode_index", "index", "task_index")


class Writer:
    """Writes episodes, one data file per task, and the metadata when it is closed."""

    def __init__(self, folder: Path, image_size: int) -> None:
        """Create the folder.

        Raises:
            FileExistsError: it exists.
        """
        folder.mkdir(parents=True)
        self._folder, self._size = folder, image_size
        self._tasks: list[str] = []
        self._episodes: list[dict[str, Any]] = []
        self._values: dict[str, list[np.ndarray]] = {name: [] for name in AXES}
        self._frames = 0

    def add_task(self, instruction: str, episodes: Sequence[Recorded]) -> None:
        """Write the episodes of a task."""
        task = len(self._tasks)
        self._tasks.append(instruction)
        path = self._folder / f"data/chunk-000/file-{task:03d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        with pq.ParquetWriter(path, self._schema()) as file:
            for pictures, state, action in episodes:
                file.write_table(self._rows(task, pictures, state, action))

    def close(self) -> None:
        """Write the metadata, without which the folder is no dataset."""
        meta = self._folder / "meta"
        (meta / "episodes/chunk-000").mkdir(parents=True)
        pq.write_table(
            pa.Table.from_pylist(self._episodes), meta / "episodes/chunk-000/file-000.parquet"
        )
        tasks = pa.table({"task_index": range(len(self._tasks)), "task": self._tasks})
        index = json.dumps({"index_columns": ["task"], "columns": [], "column_indexes": []})
        pq.write_table(tasks.replace_schema_metadata({"pandas": index}), meta / "tasks.parquet")
        (meta / "stats.json").write_text(json.dumps(self._statistics(), indent=1))
        (meta / "info.json").write_text(json.dumps(self._info(), indent=1))

    def _rows(
        self, task: int, pictures: Sequence[bytes], state: np.ndarray, action: np.ndarray
    ) -> pa.Table:
        """Build the table of an episode and record its place."""
        length, number, first = len(state), len(self._episodes), self._frames
        self._frames += length
        self._episodes.append(
            {
                "episode_index": number,
                "tasks": [self._tasks[task]],
                "length": length,
                "dataset_from_index": first,
                "dataset_to_index": first + length,
                "data/chunk_index": 0,
                "data/file_index": task,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
        values = {"observation.state": state, "action": action}
        for name, rows in values.items():
            self._values[name].append(rows)
        return pa.table(
            {
                PICTURE: [{"bytes": png, "path": None} for png in pictures],
                **{name: rows.tolist() for name, rows in values.items()},
                "timestamp": np.arange(length, dtype=np.float32) / FPS,
                "frame_index": range(length),
                "episode_index": [number] * length,
                "index": range(first, first + length),
                "task_index": [task] * length,
            },
            self._schema(),
        )

    @staticmethod
    def _schema() -> pa.Schema:
        picture = pa.struct({"bytes": pa.binary(), "path": pa.string()})
        vectors = {name: pa.list_(pa.float32(), len(axes)) for name, axes in AXES.items()}
        counters = dict.fromkeys(COUNTERS, pa.int64())
        return pa.schema({PICTURE: picture, **vectors, "timestamp": pa.float32(), **counters})

    def _statistics(self) -> dict[str, Any]:
        rows = {name: np.concatenate(values) for name, values in self._values.items()}
        return {
            name: {
                **{key: getattr(x, key)(0).tolist() for key in ("min", "max", "mean", "std")},
                "count": [len(x)],
            }
            for name, x in rows.items()
        }

    def _info(self) -> dict[str, Any]:
        shape = [self._size, self._size, 3]
        names = ["height", "width", "channels"]
        scalars = {"timestamp": "float32", **dict.fromkeys(COUNTERS, "int64")}
        return {
            "codebase_version": "v3.0",
            "robot_type": "metaworld_sawyer",
            "fps": FPS,
            "total_episodes": len(self._episodes),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": 1000,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": None,
            "features": {
                PICTURE: {"dtype": "image", "shape": shape, "names": names},
                **{
                    name: {"dtype": "float32", "shape": [len(axes)], "names": axes}
                    for name, axes in AXES.items()
                },
                **{n: {"dtype": t, "shape": [1], "names": None} for n, t in scalars.items()},
            },
        }


def png(picture: np.ndarray) -> bytes:
    """Encode a picture, uint8 `[H, W, 3]`."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "png", compress_level=1)
    return buffer.getvalue()
