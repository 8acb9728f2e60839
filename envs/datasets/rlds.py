"""Episodes on disk as an RLDS dataset of tensorflow-datasets, written and read without TensorFlow.

    rlds.write(episodes, "data/press")
    episodes = rlds.read("data/press")
    source = tfds.builder_from_directory("data/press").as_data_source("train")  # anybody else

Pictures are PNG: whoever trains on them sees the same pixels as whoever made them. What all
episodes share is in the dataset's metadata (`builder.info.metadata`, the file metadata.json), and
once more in every episode's own, there rounded to float32.
"""

import contextlib
import functools
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import tensorflow_datasets as tfds
from array_record.python import array_record_module

from envs.datasets import rlds_schema
from envs.datasets.episodes import SHARED, Episodes
from envs.datasets.files import reason, regular
from envs.datasets.locks import locked
from envs.datasets.rlds_reading import (
    FORMAT,
    METADATA,
    SPLIT,
    THREADS,
    Reader,
    damage,
    metadata,
    read,
)
from envs.datasets.writing import atomic_folder, sync, write_text

__all__ = ["METADATA", "ShardWriter", "Reader", "metadata", "read", "write"]

_VERSION = "1.0.0"
_DESCRIPTIONS = {
    True: "Scripted expert episodes of {task} by {robot} in simulation.",
    False: "Recorded episodes of {task} by {robot}.",
}
# One episode is read at a time, and PNG does not shrink any further (measured: 7 times as fast).
_RECORDS = "group_size:1,uncompressed"


def write(episodes: Episodes, path: str | os.PathLike[str]) -> None:
    """Writes a dataset folder, which is there only when all of it is.

    Args:
        episodes: successful ones, as `envs.collect` gives them: the last step has reward 1.
        path: the folder to make.

    Raises:
        ValueError: if the path already exists, another process is writing it, or the arrays do
            not fit one another.
        OSError: if there is no room for it.
    """
    with locked(Path(path)), atomic_folder(path) as folder:
        parts = ShardWriter(folder, {})
        parts.append(episodes)
        parts.complete()


class ShardWriter:
    """A dataset that grows part by part in a folder.

    Its metadata names the finished parts and is replaced after each of them, so a process may be
    killed at any moment: a part is there whole or does not count.

    Attributes:
        folder: where the parts are.
        facts: the metadata: what `Episodes` says of itself; `options`, how the episodes were made;
            `parts`, the number of episodes in each; `steps`, control steps in all; `cameras`, rows
            and columns of each one's pictures.
    """

    def __init__(self, folder: Path, options: Mapping[str, Any]):
        """Opens a folder, to continue what is there.

        Args:
            folder: made if it does not exist.
            options: JSON values that must agree with those that the folder was begun with.

        Raises:
            ValueError: if they do not, or if a part is damaged.
        """
        self.folder = folder
        self.metadata: dict[str, Any] = {"format": FORMAT, "options": dict(options), "parts": []}
        self.metadata |= {"steps": 0, "attempted": 0}
        if (folder / METADATA).exists():
            self.metadata = metadata(folder)
            for rest in folder.glob(f".{METADATA}.*"):  # of a process that was killed
                rest.unlink()
            _check_same(folder, self.metadata["options"], options)
            for number, episodes in enumerate(self.metadata["parts"]):
                _check_whole(self._file(number), episodes)
        else:
            folder.mkdir(parents=True, exist_ok=True)
            self._save()

    @property
    def num_episodes(self) -> int:
        """Episodes in finished parts."""
        return sum(self.metadata["parts"])

    @property
    def attempted(self) -> int:
        """Episodes tried to get these."""
        return self.metadata["attempted"]

    def append(self, episodes: Episodes) -> None:
        """Adds a part; `attempted` adds up.

        Raises:
            ValueError: if the arrays do not fit one another or the episodes not those before.
            OSError: if there is no room for it; the parts before it are as they were.
        """
        episodes.validate()
        shared: dict[str, Any] = {name: getattr(episodes, name) for name in SHARED}
        shared["instructions"] = list(episodes.instructions)
        shared["cameras"] = {name: list(x.shape[2:4]) for name, x in episodes.image.items()}
        features = rlds_schema.features(episodes)
        if not self.metadata["parts"]:
            features.save_config(str(self.folder))
            self.metadata |= shared
        _check_same(self.folder, {name: self.metadata[name] for name in shared}, shared)
        to = rlds_schema.serializer(features)
        record = functools.partial(rlds_schema.record, to, jax.device_get(episodes))
        first, numbers = self.num_episodes, range(episodes.num_episodes)
        data = THREADS.map(record, numbers, range(first, first + len(numbers)))
        _write_records(self._file(len(self.metadata["parts"])), data)
        self.metadata["parts"].append(len(numbers))
        self.metadata["steps"] += episodes.num_steps
        self.metadata["attempted"] += episodes.attempted
        self._save()

    def complete(self) -> None:
        """Describes the parts to tfds, which makes the folder a dataset."""
        files = [self._file(number) for number in range(len(self.metadata["parts"]))]
        identity = tfds.core.DatasetIdentity(
            name=self._name,
            version=tfds.core.Version(_VERSION),
            data_dir=str(self.folder),
            module_name="",
        )
        with damage(self.folder, ": delete it to start anew"):
            features = rlds_schema.stored(self.folder)
        info = tfds.core.DatasetInfo(
            builder=identity,
            description=_DESCRIPTIONS[bool(self.metadata["physics_dt"])].format(**self.metadata),
            features=features,
        )
        info.set_file_format(tfds.core.FileFormat.ARRAY_RECORD)
        split = tfds.core.SplitInfo(
            name=SPLIT,
            shard_lengths=self.metadata["parts"],
            num_bytes=sum(file.stat().st_size for file in files),
            filename_template=self._template,
        )
        info.set_splits(tfds.core.SplitDict([split]))
        (self.folder / rlds_schema.INFO).unlink(missing_ok=True)  # of a process that was killed
        info.write_to_directory(self.folder)

    def _save(self) -> None:
        write_text(self.folder / METADATA, json.dumps(self.metadata, indent=2))

    @property
    def _name(self) -> str:
        robot = Path(self.metadata["robot"]).stem  # a user's is a path
        name = f"{self.metadata['task']}_{robot}"
        return re.sub(r"[^\w.-]", "_", name)[:100]  # a part of the names of files

    @property
    def _template(self) -> tfds.core.ShardedFileTemplate:
        return tfds.core.ShardedFileTemplate(
            data_dir=tfds.core.Path(self.folder),
            template=rlds_schema.FILES,
            dataset_name=self._name,
            split=SPLIT,
            filetype_suffix=tfds.core.FileFormat.ARRAY_RECORD.file_suffix,
        )

    def _file(self, number: int) -> Path:
        return Path(self._template.sharded_filepath(shard_index=number, num_shards=None))


def _check_same(folder: Path, there: Mapping[str, Any], new: Mapping[str, Any]) -> None:
    """Raises a ValueError that names the first difference."""
    for name in sorted(there.keys() | new.keys()):
        if there.get(name) != new.get(name):
            raise ValueError(
                f"{folder} was begun with {name} {there.get(name)!r}, not {new.get(name)!r}: "
                "finish it with that, or delete it to start anew"
            )


def _write_records(file: Path, records: Iterable[bytes]) -> None:
    """Raises an OSError if there is no room for all; the library's own error is another one."""
    writer = array_record_module.ArrayRecordWriter(str(file), _RECORDS)
    for record in records:
        with _failure_in_one_sentence(file):
            writer.write(record)
    with _failure_in_one_sentence(file):
        writer.close()
    sync(file)


def _check_whole(file: Path, episodes: int) -> None:
    """Raises a ValueError if a part is damaged; every record has a checksum."""
    with damage(file, f": delete {file.parent} to start anew"):
        reader = array_record_module.ArrayRecordReader(str(regular(file, file.parent)))
        if reader.num_records() != episodes or len(reader.read_all()) != episodes:
            raise ValueError(f"it holds {reader.num_records()} episodes, not {episodes}")
        reader.close()


@contextlib.contextmanager
def _failure_in_one_sentence(file: Path) -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        why = reason(error).partition("; ")[0]  # the rest is where in the file
        raise OSError(f"{file} could not be written ({why})") from error
