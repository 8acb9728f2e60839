"""RLDS datasets of tensorflow-datasets (tfds), written and read without TensorFlow.

    rlds.write(episodes, "data/press")
    episodes = rlds.read("data/press")
    source = tfds.builder_from_directory("data/press").as_data_source("train")  # with tfds alone

Images are lossless PNG. Metadata that all episodes share is in metadata.json, which tfds reads as
`builder.info.metadata`. Every episode repeats most of it, with floats rounded to float32.
"""

import contextlib
import functools
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tensorflow_datasets as tfds
from array_record.python import array_record_module
from array_record.python.array_record_data_source import ArrayRecordDataSource
from google.protobuf.message import DecodeError

from envs.datasets import rlds_schema
from envs.datasets.episodes import SHARED, Episodes, choose_cameras, concatenate
from lorasp_jax.base import json_values
from lorasp_jax.base.files import as_value_error, check_regular, first_line, read_json
from lorasp_jax.base.locks import locked
from lorasp_jax.base.writing import atomic_folder, sync, write_text

METADATA = "metadata.json"
"""Metadata file in a dataset's folder; tfds reads it, too."""
_THREADS = ThreadPoolExecutor(8)
"""Shared by all open datasets: more threads would only wait for the GIL."""
_TYPES: dict[str, Any] = {
    "options": {
        **{"names?": [str], "action_names?": [str]},
        "grippers?": {"state": [int], "action": [int]},
    },
    "parts": [int],
    "steps": int,
    "attempted": int,
}
"""Schema of the metadata of every dataset, see `json_values.check`."""
_SHARD_TYPES: dict[str, Any] = {
    **{"task": str, "robot": str, "actions": str, "instructions": [str]},
    **{"cameras": {str: (int, int)}, "control_dt": float, "physics_dt": float},
    **{"widths?": (int, int), "corrected?": bool},
}
"""Schema of the fields that appear with the first shard."""
_FORMAT, _SPLIT, _VERSION = "envs-rlds-1", "train", "1.0.0"
_INFO = "dataset_info.json"
"""File of tfds, written last, so that it marks a complete dataset."""
_FILES = "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_INDEX}"
"""Template of shard names, as used by tfds.core.SequentialWriter."""
_DESCRIPTIONS = {
    True: "Scripted expert episodes of {task} by {robot} in simulation.",
    False: "Recorded episodes of {task} by {robot}.",
}
# 7x as fast as the default (measured), since episodes are read one by one and PNG data does not
# compress further.
_RECORDS = "group_size:1,uncompressed"


def read(path: str | os.PathLike[str]) -> Episodes:
    """Read a dataset written by `write` or `python -m envs collect` into host memory.

    Episodes are padded with zeros to the longest one.

    Raises:
        ValueError: the folder is missing, damaged or not a dataset of this format.
    """
    reader = Reader(path)
    parts = list(_THREADS.map(reader.episode, range(len(reader))))
    with _reading(reader.path):
        return replace(concatenate(parts), attempted=reader.metadata["attempted"])


def metadata(path: Path) -> dict[str, Any]:
    """Read the metadata of a dataset (see `ShardWriter`).

    Raises:
        ValueError: as in `read`.
    """
    with _reading(path):
        content = read_json(path / METADATA, path)
        json_values.check(content, {"format": str})
        if content["format"] != _FORMAT:
            raise ValueError(f"its format is not {_FORMAT}")
        json_values.check(content, _TYPES | (_SHARD_TYPES if content["parts"] else {}))
    return content


class Reader:
    """A dataset written by `write` or `python -m envs collect`, read one episode at a time.

    Attributes:
        kind: name of the format.
        path: folder of the dataset.
        metadata: see `ShardWriter`.
        cameras: camera -> feature of its images.
        left_out: camera -> why it is not among the cameras.
        control_dt: time between two actions [s].
        num_steps: total number of control steps.
        names: "state" and "action" -> names of their dimensions; empty if nothing names them.
        grippers: "state" and "action" -> which of these are grippers.
    """

    kind = "RLDS"

    def __init__(self, path: str | os.PathLike[str], cameras: Sequence[str] = ()) -> None:
        """Open a dataset.

        Args:
            path: the folder.
            cameras: names of the cameras to use; empty: all.

        Raises:
            ValueError: as in `read`, or a camera is unknown.
        """
        self.path: Path = Path(path)
        self.metadata: dict[str, Any] = metadata(self.path)
        with _reading(self.path):
            sizes = self.metadata["cameras"]
        available = {name: rlds_schema.image_feature(name) for name in sizes}
        self.cameras: dict[str, str]
        self.left_out: dict[str, str]
        self.cameras, self.left_out = choose_cameras(available, cameras, self.path)
        with _reading(self.path):
            self.control_dt: float = float(self.metadata["control_dt"])
            self.num_steps: int = self.metadata["steps"]
            self.names: dict[str, list[str]]
            self.grippers: dict[str, list[int]]
            self.names, self.grippers = _dimensions(self.metadata)
            self._shared: dict[str, Any] = {name: self.metadata[name] for name in SHARED}
            self._shared |= {"instructions": tuple(self.metadata["instructions"]), "attempted": 1}
            check_regular(self.path / _INFO, self.path)
            shards = sorted(self.path.glob(f"*-{_SPLIT}.array_record-*"))
            # macOS writes a file ._NAME beside each file NAME on some drives.
            copies = {file.with_name(f"._{file.name}") for file in shards}
            shards = [file for file in shards if file not in copies]
            shards = shards[: len(self.metadata["parts"])]  # the next one may be incomplete
            self._records = ArrayRecordDataSource([check_regular(f, self.path) for f in shards])
            if len(self) != (expected := sum(self.metadata["parts"])):
                raise ValueError(f"expected {expected} episodes, found {len(self)}")

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self._records)

    def episode(self, number: int, cameras: Sequence[str] | None = None) -> Episodes:
        """Load one episode into host memory.

        Args:
            number: index of the episode.
            cameras: cameras to load; None: all.

        Raises:
            ValueError: it is damaged or incomplete.
        """
        names = self.cameras if cameras is None else cameras
        selected = {name: self.cameras[name] for name in names}
        sizes, widths = self.metadata["cameras"], self.metadata.get("widths", (0, 0))
        with _reading(Path(f"{self.path}: episode {number}")):
            record = self._records[number]
            episode = rlds_schema.episode(record, selected, sizes, widths, self._shared)
            episode.validate_numbers()
            return episode


def _dimensions(metadata: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the names of the dimensions and which of them are grippers, as `Reader` has them."""
    options, widths = metadata["options"], metadata.get("widths", (0, 0))
    states = options.get("names", [])
    names = {"state": states, "action": options.get("action_names", states)} if states else {}
    known = {kind: [i for i, name in enumerate(row) if "gripper" in name]
             for kind, row in names.items()}  # fmt: skip
    grippers = options.get("grippers", known)
    for kind, width in zip(("state", "action"), widths, strict=True):
        if names and len(names[kind]) != width:
            raise ValueError(f"options.names must name all dimensions, got {len(names[kind])}")
        if not {*grippers.get(kind, [])} <= {*range(width)}:
            raise ValueError(f"options.grippers of {kind} must be of {width} dimensions")
    return names, grippers


def write(episodes: Episodes, path: str | os.PathLike[str]) -> None:
    """Write a dataset folder, which appears only once it is complete.

    Args:
        episodes: as from `envs.collect`. The last steps of those that succeed get reward 1.
        path: folder to create.

    Raises:
        ValueError: the path already exists, another process is writing it, or the arrays are
            inconsistent.
        OSError: the disk is full.
    """
    with locked(Path(path)), atomic_folder(path) as folder:
        writer = ShardWriter(folder, {})
        writer.append(episodes)
        writer.complete()


class ShardWriter:
    """Write a dataset shard by shard, resuming after the complete shards in its folder.

    The process may be killed at any time: the metadata file lists the complete shards and is
    replaced atomically after each one, and an incomplete shard is ignored.

    Attributes:
        folder: folder of the shards.
        metadata: content of metadata.json:

            - the fields of `Episodes` that all shards share;
            - `options`: how the episodes were made; `names` of the dimensions of states and
              actions if they are not one arm's, `action_names` of actions if these have others;
              `grippers`, which of them are grippers, if the names do not say it;
            - `parts`: number of episodes in each shard;
            - `steps`, `attempted`: total number of control steps and of attempts;
            - `cameras`: height and width of each camera's images;
            - `widths`: number of values in a state and in an action;
            - `corrected`: whether steps say that a person took over.
    """

    def __init__(self, folder: Path, options: Mapping[str, Any]):
        """Open or create a folder.

        Args:
            folder: created if it does not exist.
            options: JSON values; an existing folder must have been created with the same.

        Raises:
            ValueError: the options differ, or a shard is damaged.
        """
        self.folder = folder
        self.metadata: dict[str, Any] = {"format": _FORMAT, "options": dict(options), "parts": []}
        self.metadata |= {"steps": 0, "attempted": 0}
        if (folder / METADATA).exists():
            self.metadata = metadata(folder)
            for leftover in folder.glob(f".{METADATA}.*"):  # left by a killed process
                leftover.unlink()
            _check_same(folder, self.metadata["options"], options)
            for number, episodes in enumerate(self.metadata["parts"]):
                _check_shard(self._file(number), episodes)
        else:
            folder.mkdir(parents=True, exist_ok=True)
            self._save()

    @property
    def num_episodes(self) -> int:
        """Number of episodes in complete shards."""
        return sum(self.metadata["parts"])

    @property
    def attempted(self) -> int:
        """Number of attempts; the episodes are the successful ones."""
        return self.metadata["attempted"]

    def append(self, episodes: Episodes) -> None:
        """Append a shard, and add its attempts to `attempted`; instructions may be added, too.

        Raises:
            ValueError: the arrays are inconsistent, or the metadata differs from earlier shards.
            OSError: the disk is full; earlier shards are unaffected.
        """
        episodes.validate()
        episodes = self._with_corrections(episodes)
        shared: dict[str, Any] = {name: getattr(episodes, name) for name in SHARED}
        shared["instructions"] = list(episodes.instructions)
        shared["cameras"] = {name: list(x.shape[2:4]) for name, x in episodes.image.items()}
        shared["widths"] = [episodes.state.shape[2], episodes.action.shape[2]]
        if not self.metadata["parts"]:
            self.metadata |= shared
        before = len(self.metadata["instructions"])  # episodes have indices into them
        if shared["instructions"][:before] == self.metadata["instructions"]:
            self.metadata["instructions"] = shared["instructions"]
        _check_same(self.folder, {name: self.metadata.get(name) for name in shared}, shared)
        serializer = rlds_schema.serializer(rlds_schema.features(self.metadata))
        record = functools.partial(rlds_schema.record, serializer, jax.device_get(episodes))
        first, numbers = self.num_episodes, range(episodes.num_episodes)
        records = _THREADS.map(record, numbers, range(first, first + len(numbers)))
        _write_records(self._file(len(self.metadata["parts"])), records)
        self.metadata["parts"].append(len(numbers))
        self.metadata["steps"] += episodes.num_steps
        self.metadata["attempted"] += episodes.attempted
        self._save()

    def _with_corrections(self, episodes: Episodes) -> Episodes:
        """Return episodes that say where a person took over if those of the first shard do."""
        given = episodes.corrected is not None
        says = self.metadata.setdefault("corrected", given and not self.metadata["parts"])
        flags = episodes.corrected if given else np.zeros(episodes.state.shape[:2], bool)
        if np.any(flags) and not says:
            raise ValueError(f"{self.folder} cannot mark corrections: choose another folder")
        return replace(episodes, corrected=flags if says else None)

    def complete(self) -> None:
        """Write tfds's description of the shards, which completes the dataset."""
        files = [self._file(number) for number in range(len(self.metadata["parts"]))]
        identity = tfds.core.DatasetIdentity(
            name=self._name,
            version=tfds.core.Version(_VERSION),
            data_dir=str(self.folder),
            module_name="",
        )
        with _reading(self.folder, ": delete it to start over"):
            features = rlds_schema.features(self.metadata)
        info = tfds.core.DatasetInfo(
            builder=identity,
            description=_DESCRIPTIONS[bool(self.metadata["physics_dt"])].format(**self.metadata),
            features=features,
        )
        info.set_file_format(tfds.core.FileFormat.ARRAY_RECORD)
        split = tfds.core.SplitInfo(
            name=_SPLIT,
            shard_lengths=self.metadata["parts"],
            num_bytes=sum(file.stat().st_size for file in files),
            filename_template=self._template,
        )
        info.set_splits(tfds.core.SplitDict([split]))
        (self.folder / _INFO).unlink(missing_ok=True)  # left by a killed process
        info.write_to_directory(self.folder)

    def _save(self) -> None:
        write_text(self.folder / METADATA, json.dumps(self.metadata, indent=2))

    @property
    def _name(self) -> str:
        robot = Path(self.metadata["robot"]).stem  # the name of a user's own robot is a path
        name = f"{self.metadata['task']}_{robot}"
        return re.sub(r"[^\w.-]", "_", name)[:100]  # becomes part of file names

    @property
    def _template(self) -> tfds.core.ShardedFileTemplate:
        return tfds.core.ShardedFileTemplate(
            data_dir=tfds.core.Path(self.folder),
            template=_FILES,
            dataset_name=self._name,
            split=_SPLIT,
            filetype_suffix=tfds.core.FileFormat.ARRAY_RECORD.file_suffix,
        )

    def _file(self, number: int) -> Path:
        return Path(self._template.sharded_filepath(shard_index=number, num_shards=None))


def _check_same(folder: Path, old: Mapping[str, Any], new: Mapping[str, Any]) -> None:
    """Raise a ValueError that names the first difference, if there is one."""
    for name in sorted(old.keys() | new.keys()):
        if old.get(name) != new.get(name):
            was, now = old.get(name), new.get(name)
            raise ValueError(f"{folder} has {name} {was!r}, not {now!r}: choose another folder")


def _write_records(file: Path, records: Iterable[bytes]) -> None:
    """Write a file of records, raising OSError in place of the library's RuntimeError."""
    writer = array_record_module.ArrayRecordWriter(str(file), _RECORDS)
    for record in records:
        with _as_os_error(file):
            writer.write(record)
    with _as_os_error(file):
        writer.close()
    sync(file)


def _check_shard(file: Path, episodes: int) -> None:
    """Raise a ValueError if a shard is damaged; reading verifies each record's checksum."""
    with _reading(file, f": delete {file.parent} to start over"):
        reader = array_record_module.ArrayRecordReader(str(check_regular(file, file.parent)))
        if reader.num_records() != episodes or len(reader.read_all()) != episodes:
            raise ValueError(f"expected {episodes} episodes, found {reader.num_records()}")
        reader.close()


@contextlib.contextmanager
def _as_os_error(file: Path) -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        cause = first_line(error).partition("; ")[0]  # the rest is a position in the file
        raise OSError(f"cannot write {file} ({cause})") from error


def _reading(path: Path, remedy: str = "") -> contextlib.AbstractContextManager[None]:
    """Convert errors as `files.as_value_error` does, including protobuf's."""
    return as_value_error(path, DecodeError, remedy=remedy)
