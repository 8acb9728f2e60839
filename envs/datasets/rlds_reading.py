"""Read RLDS datasets without TensorFlow; `envs.datasets.rlds` writes them."""

import contextlib
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import tensorflow_datasets as tfds
from array_record.python import array_record_module
from google.protobuf.json_format import ParseError

from envs.datasets import rlds_schema
from envs.datasets.episodes import SHARED, Episodes, concatenate
from lorasp_jax.base import files, json_values
from lorasp_jax.base.files import check_regular, read_json

FORMAT, SPLIT = "envs-rlds-1", "train"
METADATA = "metadata.json"
"""Metadata file in a dataset's folder; tfds reads it, too."""
THREADS = ThreadPoolExecutor(8)
"""Shared by all open datasets: more threads would only wait for the GIL."""
_TYPES: dict[str, Any] = {"options": {}, "parts": [int], "steps": int, "attempted": int}
"""Schema of the metadata of every dataset, see `json_values.check`."""
_SHARD_TYPES: dict[str, Any] = {
    **{"task": str, "robot": str, "actions": str, "instructions": [str]},
    **{"cameras": {str: (int, int)}, "control_dt": float, "physics_dt": float},
}
"""Schema of the fields that appear with the first shard."""


def read(path: str | os.PathLike[str]) -> Episodes:
    """Read a dataset written by `write` or `python -m envs collect` into host memory.

    Episodes are padded with zeros to the longest one.

    Raises:
        ValueError: the folder is missing, damaged or not a dataset of this format.
    """
    reader = Reader(path)
    parts = list(THREADS.map(reader.episode, range(len(reader))))
    with as_value_error(reader.path):
        return replace(concatenate(parts), attempted=reader.metadata["attempted"])


def metadata(path: Path) -> dict[str, Any]:
    """Read the metadata of a dataset (see `ShardWriter`).

    Raises:
        ValueError: as in `read`.
    """
    with as_value_error(path):
        content = read_json(path / METADATA, path)
        if content["format"] != FORMAT:
            raise ValueError(f"its format is not {FORMAT}")
        json_values.check(content, _TYPES | (_SHARD_TYPES if content["parts"] else {}))
    return content


class Reader:
    """A dataset written by `write` or `python -m envs collect`, read one episode at a time.

    Attributes:
        kind: name of the format.
        path: folder of the dataset.
        metadata: see `ShardWriter`.
        cameras: camera -> feature of its images.
        control_dt: time between two actions [s].
        num_steps: total number of control steps.
    """

    kind = "RLDS"

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Open a dataset.

        Raises:
            ValueError: as in `read`.
        """
        self.path: Path = Path(path)
        self.metadata: dict[str, Any] = metadata(self.path)
        with as_value_error(self.path):
            cameras = self.metadata["cameras"]
            self.cameras: dict[str, str] = {n: rlds_schema.image_feature(n) for n in cameras}
            self.control_dt: float = float(self.metadata["control_dt"])
            self.num_steps: int = self.metadata["steps"]
            self._shared: dict[str, Any] = {name: self.metadata[name] for name in SHARED}
            self._shared |= {"instructions": tuple(self.metadata["instructions"]), "attempted": 1}
            builder = _builder(self.path, self.metadata["parts"])
            # `rlds_schema.episode` decodes only selected cameras, and checks image sizes first.
            encoded = {name: tfds.decode.SkipDecoding() for name in self.cameras.values()}
            decoders = {"steps": {"observation": encoded}}
            self._source = builder.as_data_source(SPLIT, decoders=decoders)

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self._source)

    def episode(self, number: int, cameras: Sequence[str] | None = None) -> Episodes:
        """Load one episode into host memory.

        Args:
            number: index of the episode.
            cameras: cameras to load; None: all.

        Raises:
            ValueError: it is damaged or incomplete.
        """
        with as_value_error(self.path):
            names = self.cameras if cameras is None else cameras
            selected = {name: self.cameras[name] for name in names}
            sizes = self.metadata["cameras"]
            episode = rlds_schema.episode(self._source[number], selected, sizes, self._shared)
            episode.validate_numbers()
            return episode


def _builder(folder: Path, parts: Sequence[int]) -> Any:
    """Make tfds's builder for a folder, after checking its files and the length of each shard."""
    rlds_schema.check_description(folder, rlds_schema.FEATURES, rlds_schema.INFO)
    builder: Any = tfds.builder_from_directory(folder)
    split = builder.info.splits[SPLIT]
    is_array_record = builder.info.file_format == tfds.core.FileFormat.ARRAY_RECORD
    if not is_array_record or list(split.shard_lengths) != list(parts):
        raise ValueError(f"{rlds_schema.INFO} does not match {METADATA}")
    for file, episodes in zip(split.filepaths, parts, strict=True):
        path = check_regular(files.join_inside(folder, os.path.relpath(file, folder)), folder)
        reader = array_record_module.ArrayRecordReader(str(path))
        if reader.num_records() != episodes:
            raise ValueError(f"{file} has {reader.num_records()} episodes, expected {episodes}")
        reader.close()
    return builder


def as_value_error(path: Path, remedy: str = "") -> contextlib.AbstractContextManager[None]:
    """Convert errors as `files.as_value_error` does, including those of protobuf."""
    return files.as_value_error(path, ParseError, remedy=remedy)
