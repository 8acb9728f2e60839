"""Metadata and file layout of LeRobot datasets; no other code depends on the format version.

    2.x   one parquet file per episode, one video per episode and camera; meta/*.jsonl
    3.0   many episodes per parquet file and per video; meta/**/*.parquet

Source: LeRobot, src/lerobot/datasets/utils.py, at 0.3.3 (2.1) and at 0.6.1 (3.0).
"""

import contextlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from lorasp_jax.base import files, json_values
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
_MAX_SECONDS = 2**31  # limit for the start of an episode in a video
_INFO: dict[str, Any] = {
    "codebase_version": str,
    "fps": float,
    "features": {str: {"dtype": str, "shape?": [float], "info?": {}, "video_info?": {}}},
    "data_path": str,
}
"""Schema of meta/info.json, see `json_values.check`."""
_PATHS_3 = {
    "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
}
"""Path templates that version 3.0 does not need to record."""


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
        json_values.check(info, {"codebase_version": str})
        if (version := info["codebase_version"]) not in VERSIONS:
            raise RefusedError(
                f"{path} has the codebase_version {version!r}; convert it with LeRobot to one of "
                f"{', '.join(VERSIONS)}"
            )
        info = {**(_PATHS_3 if version == "v3.0" else {}), **info}
        json_values.check(info, _INFO, nulls=True)
        fps, features = float(info["fps"]), info["features"]
        videos = [name for name, feature in features.items() if feature["dtype"] == "video"]
        robot = str(info.get("robot_type") or "unknown")
        if fps <= 0:
            raise ValueError(f"fps must be positive, got {fps}")
        if version != "v3.0" and as_int(info["chunks_size"]) < 1:
            raise ValueError(f"chunks_size must be at least 1, got {info['chunks_size']}")
    read = _read_3 if version == "v3.0" else _read_2
    tasks, episodes = read(folder, info, videos)
    _check(folder, info, episodes)
    episodes.sort(key=lambda entry: entry.number)  # as LeRobot does
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
                key: (_file(folder, info, "video_path", video_key=key, **fields), 0.0)
                for key in videos
            }
            table = _file(folder, info, "data_path", **fields)
            episodes.append(EpisodeEntry(number, as_int(row["length"]), table, files))
    return tasks, episodes


def _read_3(
    folder: Path, info: Mapping[str, Any], videos: Sequence[str]
) -> tuple[dict[int, str], list[EpisodeEntry]]:
    """Read tasks and episodes of version 3.0."""
    path = folder / "meta" / "tasks.parquet"
    with as_value_error(path):
        table = read_table(path, folder)
        # Instructions are the index of a pandas table, of any name or none.
        index = (table.schema.pandas_metadata or {}).get("index_columns", [])
        names = [n for n in (*index, "task", "__index_level_0__") if n in table.column_names]
        tasks = _tasks(path, table.to_pylist(), *names[:1])
    episodes = []
    # macOS writes hidden files ._*.parquet beside those of others.
    for path in sorted((folder / "meta" / "episodes").rglob("[!.]*.parquet")):
        with as_value_error(path):
            for row in read_table(path, folder, without="stats/").to_pylist():
                at = {name: as_int(row[f"data/{name}"]) for name in ("chunk_index", "file_index")}
                files = {key: _video_3(folder, info, key, row) for key in videos}
                table = _file(folder, info, "data_path", **at)
                number, length = as_int(row["episode_index"]), as_int(row["length"])
                episodes.append(EpisodeEntry(number, length, table, files))
    return tasks, episodes


def _tasks(path: Path, rows: Sequence[Mapping[str, Any]], column: str = "task") -> dict[int, str]:
    """Return task index -> instruction."""
    tasks: dict[int, str] = {}
    for row in rows:
        number, text = as_int(row["task_index"]), row[column]
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
    start = row[f"videos/{key}/from_timestamp"]
    json_values.check(start, float, f"videos/{key}/from_timestamp")
    if not 0 <= start < _MAX_SECONDS:
        raise ValueError(f"episode {row['episode_index']} starts at {start} s in its {key} video")
    return _file(folder, info, "video_path", video_key=key, **at), float(start)


def _file(folder: Path, info: Mapping[str, Any], name: str, **values: Any) -> Path:
    """Fill in a path template of meta/info.json.

    `str.format` is unsafe, because it evaluates attributes.
    """
    template = info.get(name)
    text = template if isinstance(template, str) else "{}"
    fields = {field for field, _ in _FIELD.findall(text)}
    if set("{}") & set(_FIELD.sub("", text)) or not fields <= values.keys():
        raise RefusedError(
            f"{folder}/meta/info.json: {name} must be a path with the fields {', '.join(values)}, "
            f"got {template!r}"
        )
    fill = lambda field: format(values[field[1]], field[2] or "")  # noqa: E731
    return join_inside(folder, _FIELD.sub(fill, text))


def read_table(
    path: Path,
    folder: Path,
    columns: Sequence[str] | None = None,
    without: str = "\0",
    optional: Sequence[str] = (),
) -> pa.Table:
    """Read a parquet file of a dataset.

    Args:
        path: the file.
        folder: the dataset's folder.
        columns: columns to read, or None for all.
        without: prefix of columns to skip.
        optional: columns to read, too, if the file has them.

    Raises:
        Exception: any error that `as_value_error` converts.
    """
    with pq.ParquetFile(check_regular(path, folder)) as file:
        names = file.schema_arrow.names
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise RefusedError(f"{path} has several columns {twice[0]}")
        if missing := [name for name in columns or () if name not in names]:
            raise KeyError(missing[0])
        selected = [name for name in columns or names if not name.startswith(without)]
        selected += [name for name in optional if name in names and name not in selected]
        check_memory(_size(file.metadata, set(selected)), path)
        return file.read(columns=selected)


def _size(metadata: pq.FileMetaData, columns: set[str]) -> int:
    """Estimate the size of columns in memory [bytes]; the file stores repeated values only once."""
    prefixes = tuple(f"{name}." for name in columns)
    groups = (metadata.row_group(i) for i in range(metadata.num_row_groups))
    chunks = (group.column(j) for group in groups for j in range(group.num_columns))
    return sum(
        max(chunk.total_uncompressed_size, _MAX_VALUE_BYTES * chunk.num_values)
        for chunk in chunks
        if f"{chunk.path_in_schema}.".startswith(prefixes)  # names may have dots, too
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
