"""Where things lie in a LeRobot dataset: versions 2.0, 2.1 and 3.0 differ only here.

    2.x   a parquet file for each episode, a video for each episode and camera; meta/*.jsonl
    3.0   many episodes in one file of either kind; meta/**/*.parquet

Source: LeRobot, src/lerobot/datasets/utils.py, at 0.3.3 (2.1) and at 0.6.1 (3.0).
"""

import collections
import contextlib
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from envs.datasets import files
from envs.datasets.files import check_memory, inside, read_json, read_text, regular, whole

VERSIONS = ("v2.0", "v2.1", "v3.0")
_FIELD = re.compile(r"\{(\w+)(?::(\d{0,2}d?))?\}")
"""A field of a template: its name, perhaps its width, as {episode_index:06d}."""
_NUMBER_BYTES = 8  # of a number in memory, at most


@dataclass(frozen=True)
class Recording:
    """Where an episode is.

    Attributes:
        number: its index in the dataset.
        length: frames.
        rows: parquet file that holds its numbers, perhaps with those of others.
        films: feature -> video file and the time at which the episode begins in it [s].
    """

    number: int
    length: int
    rows: Path
    films: Mapping[str, tuple[Path, float]]


@dataclass(frozen=True)
class Index:
    """What a dataset says of itself.

    Attributes:
        version: of the format.
        fps: frames a second.
        robot: its type, as the writer called it.
        features: name -> dtype, shape, names.
        tasks: task index -> instruction.
        recordings: of all episodes, in order.
    """

    version: str
    fps: float
    robot: str
    features: Mapping[str, Mapping[str, Any]]
    tasks: Mapping[int, str]
    recordings: Sequence[Recording]


def is_lerobot(folder: Path) -> bool:
    """Whether a folder looks like a LeRobot dataset."""
    return (folder / "meta" / "info.json").is_file()


def read_index(folder: Path) -> Index:
    """Everything but the episodes themselves.

    Raises:
        ValueError: not a LeRobot dataset of a known version, or damaged.
    """
    path = folder / "meta" / "info.json"
    if not path.is_file():
        raise ValueError(f"{folder} is not a LeRobot dataset: there is no meta/info.json in it")
    with damage(path):
        info = read_json(path, folder)
        version, fps, features = info["codebase_version"], float(info["fps"]), info["features"]
        videos = [name for name, feature in features.items() if feature["dtype"] == "video"]
        robot = str(info.get("robot_type") or "unknown")
    if version not in VERSIONS:
        raise ValueError(f"{path} is of version {version!r}; known are {', '.join(VERSIONS)}")
    if not 0 < fps < float("inf"):
        raise ValueError(f"{path} has {fps:g} frames a second")
    read = _read_3 if version == "v3.0" else _read_2
    tasks, recordings = read(folder, info, videos)
    _check(folder, info, recordings)
    return Index(version, fps, robot, features, tasks, recordings)


def _read_2(
    folder: Path, info: Mapping[str, Any], videos: Sequence[str]
) -> tuple[dict[int, str], list[Recording]]:
    """Tasks and episodes of versions 2.0 and 2.1."""
    path = folder / "meta" / "tasks.jsonl"
    with damage(path):
        tasks = {whole(row["task_index"]): str(row["task"]) for row in _json_lines(path, folder)}
    path = folder / "meta" / "episodes.jsonl"
    recordings = []
    with damage(path):
        for row in _json_lines(path, folder):
            number = whole(row["episode_index"])
            of = {"episode_index": number, "episode_chunk": number // whole(info["chunks_size"])}
            films = {
                key: (inside(folder, _filled(info["video_path"], video_key=key, **of)), 0.0)
                for key in videos
            }
            rows = inside(folder, _filled(info["data_path"], **of))
            recordings.append(Recording(number, whole(row["length"]), rows, films))
    return tasks, recordings


def _read_3(
    folder: Path, info: Mapping[str, Any], videos: Sequence[str]
) -> tuple[dict[int, str], list[Recording]]:
    """Tasks and episodes of version 3.0."""
    path = folder / "meta" / "tasks.parquet"
    with damage(path):
        # Written by pandas, whose index may or may not have kept its name.
        named = [
            {"task": row.pop("__index_level_0__", None), **row}
            for row in read_table(path, folder).to_pylist()
        ]
        tasks = {whole(row["task_index"]): str(row["task"]) for row in named}
    recordings = []
    for path in sorted((folder / "meta" / "episodes").rglob("*.parquet")):
        with damage(path):
            for row in read_table(path, folder, without="stats/").to_pylist():
                at = {name: whole(row[f"data/{name}"]) for name in ("chunk_index", "file_index")}
                films = {key: _film_3(folder, info, key, row) for key in videos}
                rows = inside(folder, _filled(info["data_path"], **at))
                number, length = whole(row["episode_index"]), whole(row["length"])
                recordings.append(Recording(number, length, rows, films))
    return tasks, recordings


def _film_3(
    folder: Path, info: Mapping[str, Any], key: str, row: Mapping[str, Any]
) -> tuple[Path, float]:
    """Where an episode's video is, in version 3.0."""
    at = {name: whole(row[f"videos/{key}/{name}"]) for name in ("chunk_index", "file_index")}
    start = float(row[f"videos/{key}/from_timestamp"])
    if not 0 <= start < math.inf:
        raise ValueError(f"episode {row['episode_index']} begins at {start} s in a film of {key}")
    return inside(folder, _filled(info["video_path"], video_key=key, **at)), start


def _filled(template: Any, **values: Any) -> str:
    """A template with its fields replaced; str.format would do more than that for a stranger."""
    if not isinstance(template, str) or set("{}") & set(_FIELD.sub("", template)):
        raise ValueError(f"{template!r} is no template of a path")
    return _FIELD.sub(lambda field: format(values[field[1]], field[2] or ""), template)


def read_table(
    path: Path, folder: Path, columns: Sequence[str] | None = None, without: str = "\0"
) -> pa.Table:
    """A parquet file of a dataset.

    Args:
        path: the file.
        folder: the dataset's.
        columns: those that are wanted; None: all.
        without: the beginning of the names of columns that are not.

    Raises:
        KeyError: a column is missing.
        Exception: of `files.regular` and pyarrow, see `damage`.
    """
    with pq.ParquetFile(regular(path, folder)) as file:
        there = file.schema_arrow.names
        for name in columns or ():
            if name not in there:
                raise KeyError(name)
        wanted = [name for name in columns or there if not name.startswith(without)]
        check_memory(_size(file.metadata, set(wanted)), path)
        return file.read(columns=wanted)


def _size(metadata: pq.FileMetaData, columns: set[str]) -> int:
    """Bytes that columns take in memory: a million equal numbers are a few in the file."""
    groups = (metadata.row_group(i) for i in range(metadata.num_row_groups))
    parts = (group.column(j) for group in groups for j in range(group.num_columns))
    return sum(
        max(part.total_uncompressed_size, _NUMBER_BYTES * part.num_values)
        for part in parts
        if columns & {part.path_in_schema, part.path_in_schema.partition(".")[0]}
    )


def _check(folder: Path, info: Mapping[str, Any], recordings: Sequence[Recording]) -> None:
    """Raise ValueError unless these are all the episodes there should be, none of them empty."""
    if not recordings:
        raise ValueError(f"{folder} holds no episode")
    numbers = collections.Counter(recording.number for recording in recordings)
    number, times = numbers.most_common(1)[0]
    if times > 1:
        raise ValueError(f"{folder} lists an episode twice: number {number}")
    empty = [recording.number for recording in recordings if recording.length < 1]
    if empty:
        raise ValueError(f"episode {empty[0]} of {folder} is empty")
    frames = sum(recording.length for recording in recordings)
    for name, found in (("total_episodes", len(recordings)), ("total_frames", frames)):
        if info.get(name, found) != found:
            raise ValueError(
                f"{folder} says {name} is {info[name]} in meta/info.json, but lists {found}"
            )


def _json_lines(path: Path, folder: Path) -> Iterator[dict[str, Any]]:
    return (json.loads(line) for line in read_text(path, folder).splitlines() if line.strip())


def damage(path: Path) -> contextlib.AbstractContextManager[None]:
    """`files.damage`, of pyarrow's errors too."""
    return files.damage(path, pa.ArrowException)
