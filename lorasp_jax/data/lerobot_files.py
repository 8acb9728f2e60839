"""Metadata and file layout of LeRobot datasets; no other code depends on the format version.

    2.x   one parquet file per episode, one video per episode and camera; meta/*.jsonl
    3.0   many episodes per parquet file and per video; meta/**/*.parquet

Source: LeRobot, src/lerobot/datasets/utils.py, at 0.3.3 (2.1) and at 0.6.1 (3.0).
"""

import contextlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from lorasp_jax.base import files
from lorasp_jax.base.files import (
    RefusedError,
    as_int,
    check_memory,
    check_regular,
    join_inside,
    read_json,
    read_json_lines,
)

VERSIONS = ("v2.0", "v2.1", "v3.0")
_FIELD = re.compile(r"\{(\w+)(?::(\d{0,2}d?))?\}")
"""A field of a path template, with an optional width: {episode_index:06d}."""
_MAX_VALUE_BYTES = 8  # maximum size of a value in memory


@dataclass(frozen=True)
class EpisodeEntry:
    """Files of an episode.

    Attributes:
        number: index of the episode in the dataset.
        length: number of frames.
        table: parquet file with states and actions; other episodes may share it.
        videos: feature -> video file, and the episode's start time in it [s].
    """

    number: int
    length: int
    table: Path
    videos: Mapping[str, tuple[Path, float]]


@dataclass(frozen=True)
class Index:
    """Metadata of a dataset.

    Attributes:
        version: version of the format.
        fps: frames per second.
        robot: `robot_type` in meta/info.json.
        features: name -> dtype, shape, names.
        tasks: task index -> instruction.
        episodes: files of all episodes, in order.
    """

    version: str
    fps: float
    robot: str
    features: Mapping[str, Mapping[str, Any]]
    tasks: Mapping[int, str]
    episodes: Sequence[EpisodeEntry]


def read_index(folder: Path) -> Index:
    """Read the metadata of a dataset.

    Raises:
        ValueError: the dataset is damaged, or not a LeRobot dataset of a supported version.
    """
    path = folder / "meta" / "info.json"
    with as_value_error(path):
        info = read_json(path, folder)
        version, fps, features = info["codebase_version"], float(info["fps"]), info["features"]
        videos = [name for name, feature in features.items() if feature["dtype"] == "video"]
        robot = str(info.get("robot_type") or "unknown")
        if version not in VERSIONS or not 0 < fps < math.inf:
            valid = f"{', '.join(VERSIONS)} and a positive number of"
            raise ValueError(f"it must have version {valid} fps, got {version} and {fps}")
    read = _read_3 if version == "v3.0" else _read_2
    tasks, episodes = read(folder, info, videos)
    _check(folder, info, episodes)
    return Index(version, fps, robot, features, tasks, episodes)


def _read_2(
    folder: Path, info: Mapping[str, Any], videos: Sequence[str]
) -> tuple[dict[int, str], list[EpisodeEntry]]:
    """Read tasks and episodes of versions 2.0 and 2.1."""
    path = folder / "meta" / "tasks.jsonl"
    with as_value_error(path):
        tasks = _tasks(path, read_json_lines(path, folder))
    path = folder / "meta" / "episodes.jsonl"
    episodes = []
    with as_value_error(path):
        for row in read_json_lines(path, folder):
            number = as_int(row["episode_index"])
            chunk = number // as_int(info["chunks_size"])
            fields = {"episode_index": number, "episode_chunk": chunk}
            files = {
                key: (
                    join_inside(folder, _format(info["video_path"], video_key=key, **fields)),
                    0.0,
                )
                for key in videos
            }
            table = join_inside(folder, _format(info["data_path"], **fields))
            episodes.append(EpisodeEntry(number, as_int(row["length"]), table, files))
    return tasks, episodes


def _read_3(
    folder: Path, info: Mapping[str, Any], videos: Sequence[str]
) -> tuple[dict[int, str], list[EpisodeEntry]]:
    """Read tasks and episodes of version 3.0."""
    path = folder / "meta" / "tasks.parquet"
    with as_value_error(path):
        # Instructions are the index of a pandas table, stored under this key if it has no name.
        rows = [
            {"task": row.pop("__index_level_0__", None), **row}
            for row in read_table(path, folder).to_pylist()
        ]
        tasks = _tasks(path, rows)
    episodes = []
    for path in sorted((folder / "meta" / "episodes").rglob("*.parquet")):
        with as_value_error(path):
            for row in read_table(path, folder, without="stats/").to_pylist():
                at = {name: as_int(row[f"data/{name}"]) for name in ("chunk_index", "file_index")}
                files = {key: _video_3(folder, info, key, row) for key in videos}
                table = join_inside(folder, _format(info["data_path"], **at))
                number, length = as_int(row["episode_index"]), as_int(row["length"])
                episodes.append(EpisodeEntry(number, length, table, files))
    return tasks, episodes


def _tasks(path: Path, rows: Sequence[Mapping[str, Any]]) -> dict[int, str]:
    """Return task index -> instruction."""
    tasks: dict[int, str] = {}
    for row in rows:
        number, text = as_int(row["task_index"]), row["task"]
        if not isinstance(text, str):
            raise RefusedError(f"{path}: task {number} must be text, got {text!r}")
        if tasks.setdefault(number, text) != text:
            raise RefusedError(f"{path}: task {number} is both {tasks[number]!r} and {text!r}")
    return tasks


def _video_3(
    folder: Path, info: Mapping[str, Any], key: str, row: Mapping[str, Any]
) -> tuple[Path, float]:
    """Return an episode's video file and its start time in that file [s], in version 3.0."""
    at = {name: as_int(row[f"videos/{key}/{name}"]) for name in ("chunk_index", "file_index")}
    start = float(row[f"videos/{key}/from_timestamp"])
    if not 0 <= start < math.inf:
        raise ValueError(f"episode {row['episode_index']} starts at {start} s in its {key} video")
    return join_inside(folder, _format(info["video_path"], video_key=key, **at)), start


def _format(template: Any, **values: Any) -> str:
    """Fill in a path template. `str.format` is unsafe, because it evaluates attributes."""
    if not isinstance(template, str) or set("{}") & set(_FIELD.sub("", template)):
        raise ValueError(f"invalid path template {template!r}")
    return _FIELD.sub(lambda field: format(values[field[1]], field[2] or ""), template)


def read_table(
    path: Path, folder: Path, columns: Sequence[str] | None = None, without: str = "\0"
) -> pa.Table:
    """Read a parquet file of a dataset.

    Args:
        path: the file.
        folder: the dataset's folder.
        columns: columns to read, without those that are missing, or None for all.
        without: prefix of columns to skip.

    Raises:
        Exception: any error that `as_value_error` converts.
    """
    with pq.ParquetFile(check_regular(path, folder)) as file:
        names = file.schema_arrow.names
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise RefusedError(f"{path} has several columns {twice[0]}")
        available = columns or names
        selected = [name for name in available if not name.startswith(without)]
        check_memory(_size(file.metadata, set(selected)), path)
        return file.read(columns=selected)


def _size(metadata: pq.FileMetaData, columns: set[str]) -> int:
    """Estimate the size of columns in memory [bytes]; the file stores repeated values only once."""
    groups = (metadata.row_group(i) for i in range(metadata.num_row_groups))
    chunks = (group.column(j) for group in groups for j in range(group.num_columns))
    return sum(
        max(chunk.total_uncompressed_size, _MAX_VALUE_BYTES * chunk.num_values)
        for chunk in chunks
        if columns & {chunk.path_in_schema, chunk.path_in_schema.partition(".")[0]}
    )


def _check(folder: Path, info: Mapping[str, Any], episodes: Sequence[EpisodeEntry]) -> None:
    """Raise ValueError if episodes are missing, listed twice or empty."""
    lengths = {entry.number: entry.length for entry in episodes}
    if len(lengths) < max(1, len(episodes)) or min(lengths.values()) < 1:
        raise ValueError(f"{folder} has no episodes, an empty one, or lists one twice")
    listed = {"total_episodes": len(lengths), "total_frames": sum(lengths.values())}
    if any(info.get(name, count) != count for name, count in listed.items()):
        raise ValueError(f"{folder}/meta/info.json does not match the episodes: {listed}")


def as_value_error(path: Path) -> contextlib.AbstractContextManager[None]:
    """Convert errors like `files.as_value_error`, and those of pyarrow and Pillow."""
    return files.as_value_error(path, pa.ArrowException, Image.DecompressionBombError)
