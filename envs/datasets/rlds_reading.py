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
from lorasp_jax.base import files
from lorasp_jax.base.files import RefusedError, as_int, check_regular, read_json

FORMAT, SPLIT = "envs-rlds-1", "train"
METADATA = "metadata.json"
"""Metadata file in a dataset's folder; tfds reads it, too."""
THREADS = ThreadPoolExecutor(8)
"""Shared by all open datasets: more threads would only wait for the GIL."""
# Types of metadata fields: those of every dataset, then those that appear with the first shard.
_TYPES: dict[str, Any] = {"options": dict, "parts": list, "steps": int, "attempted": int}
_SHARD_TYPES: dict[str, Any] = {"task": str, "robot": str, "actions": str, "instructions": list}
_SHARD_TYPES |= {"cameras": dict, "control_dt": int | float, "physics_dt": int | float}


def read(path: str | os.PathLike[str]) -> Episodes:
    """Read a dataset written by `write` or `python -m envs collect` into host memory.

    Episodes are padded with zeros to the longest one.

    Raises:
        FileNotFoundError: the folder does not exist.
        ValueError: it is damaged or not a dataset of this format.
    """
    reader = Reader(path)
    parts = list(THREADS.map(reader.episode, range(len(reader))))
    with as_value_error(reader.path):
        return replace(concatenate(parts), attempted=reader.metadata["attempted"])


def metadata(path: Path) -> dict[str, Any]:
    """Read the metadata of a dataset (see `ShardWriter`).

    Raises:
        FileNotFoundError, ValueError: as in `read`.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    try:
        content = read_json(path / METADATA, path)
        if content["format"] != FORMAT:
            raise KeyError("format")
        types = _TYPES | (_SHARD_TYPES if content["parts"] else {})
        wrong = [name for name, kind in types.items() if not isinstance(content.get(name), kind)]
    except RefusedError:
        raise
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not a folder of {FORMAT} episodes") from error
    if wrong:
        value = repr(content.get(wrong[0]))[:80]
        raise ValueError(f"{path} is damaged ({METADATA} has an invalid {wrong[0]}, {value})")
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
            FileNotFoundError, ValueError: as in `read`.
        """
        self.path: Path = Path(path)
        self.metadata: dict[str, Any] = metadata(self.path)
        with as_value_error(self.path):
            cameras = self.metadata["cameras"]
            self.cameras: dict[str, str] = {n: rlds_schema.image_feature(n) for n in cameras}
            self.control_dt: float = float(self.metadata["control_dt"])
            self.num_steps: int = as_int(self.metadata["steps"])
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
    if builder.info.file_format != tfds.core.FileFormat.ARRAY_RECORD:
        raise ValueError(f"its file format is {builder.info.file_format}, expected ARRAY_RECORD")
    if list(split.shard_lengths) != list(parts):
        raise ValueError(f"it lists {sum(split.shard_lengths)} episodes, expected {sum(parts)}")
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
