"""Datasets in RLDS form, read without TensorFlow; `envs.datasets.rlds` writes them."""

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

from envs.datasets import files, rlds_schema
from envs.datasets.episodes import SHARED, Episodes, concatenate
from envs.datasets.files import RefusedError, read_json, regular, whole

FORMAT, SPLIT = "envs-rlds-1", "train"
METADATA = "metadata.json"
"""File in a dataset's folder, where tfds looks for it, too."""
THREADS = ThreadPoolExecutor(8)
"""Shared by all datasets that are made at once: more threads would only wait for Python's lock."""
# Of metadata, in a folder that was begun, and where there are parts.
_BEGUN: dict[str, Any] = {"options": dict, "parts": list, "steps": int, "attempted": int}
_FILLED: dict[str, Any] = {"task": str, "robot": str, "actions": str, "instructions": list}
_FILLED |= {"cameras": dict, "control_dt": int | float, "physics_dt": int | float}


def read(path: str | os.PathLike[str]) -> Episodes:
    """All episodes of a dataset that `write` or `python -m envs collect` made, in host memory.

    They are padded with zeros to the longest.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if it is damaged or not such a dataset.
    """
    found = Reader(path)
    parts = list(THREADS.map(found.episode, range(len(found))))
    with damage(found.path):
        return replace(concatenate(parts), attempted=found.metadata["attempted"])


def metadata(path: Path) -> dict[str, Any]:
    """What all episodes of a dataset share, and how they were made; see `ShardWriter`.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if it is damaged or not such a dataset.
    """
    if not path.exists():
        raise FileNotFoundError(f"there is no dataset {path}")
    try:
        facts = read_json(path / METADATA, path)
        if facts["format"] != FORMAT:
            raise KeyError("format")
        kinds = _BEGUN | (_FILLED if facts["parts"] else {})
        wrong = [name for name, kind in kinds.items() if not isinstance(facts.get(name), kind)]
    except RefusedError:
        raise
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not a folder of {FORMAT} episodes") from error
    if wrong:
        value = repr(facts.get(wrong[0]))[:80]
        raise ValueError(f"{path} is damaged ({METADATA} has {wrong[0]} {value})")
    return facts


class Reader:
    """A dataset that `write` or `python -m envs collect` made, an episode at a time.

    Attributes:
        kind: the format's name.
        path: its folder.
        facts: see `ShardWriter`.
        cameras: name of a camera -> name of its pictures.
        control_dt: time between two actions [s].
        num_steps: control steps of all episodes.
    """

    kind = "RLDS"

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Opens a dataset.

        Raises:
            FileNotFoundError: if there is no such folder.
            ValueError: if it is damaged or not such a dataset.
        """
        self.path: Path = Path(path)
        self.metadata: dict[str, Any] = metadata(self.path)
        with damage(self.path):
            cameras = self.metadata["cameras"]
            self.cameras: dict[str, str] = {n: rlds_schema.picture_name(n) for n in cameras}
            self.control_dt: float = float(self.metadata["control_dt"])
            self.num_steps: int = whole(self.metadata["steps"])
            self._shared: dict[str, Any] = {name: self.metadata[name] for name in SHARED}
            self._shared |= {"instructions": tuple(self.metadata["instructions"]), "attempted": 1}
            builder = _builder(self.path, self.metadata["parts"])
            # Decoding is left to the schema: tfds would decode one picture after the other.
            encoded = {name: tfds.decode.SkipDecoding() for name in self.cameras.values()}
            decoders = {"steps": {"observation": encoded}}
            self._source = builder.as_data_source(SPLIT, decoders=decoders)

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self._source)

    def episode(self, number: int, cameras: Sequence[str] | None = None) -> Episodes:
        """One episode, in host memory.

        Args:
            number: which.
            cameras: those whose pictures are wanted; None: all.

        Raises:
            ValueError: if it is damaged or lacks something.
        """
        with damage(self.path):
            names = self.cameras if cameras is None else cameras
            wanted = {name: self.cameras[name] for name in names}
            sizes = self.metadata["cameras"]
            found = rlds_schema.episode(self._source[number], wanted, sizes, self._shared)
            found.validate_numbers()
            return found


def _builder(folder: Path, parts: Sequence[int]) -> Any:
    """What reads a folder of parts of so many episodes, once its files are what they should be."""
    rlds_schema.check_description(folder, rlds_schema.FEATURES, rlds_schema.INFO)
    builder: Any = tfds.builder_from_directory(folder)
    split = builder.info.splits[SPLIT]
    if builder.info.file_format != tfds.core.FileFormat.ARRAY_RECORD:
        raise ValueError(f"it holds files of {builder.info.file_format}")
    if list(split.shard_lengths) != list(parts):
        raise ValueError(f"it describes {sum(split.shard_lengths)} episodes, not {sum(parts)}")
    for file, episodes in zip(split.filepaths, parts, strict=True):
        path = regular(files.inside(folder, os.path.relpath(file, folder)), folder)
        reader = array_record_module.ArrayRecordReader(str(path))
        if reader.num_records() != episodes:
            raise ValueError(f"{file} holds {reader.num_records()} episodes, not {episodes}")
        reader.close()
    return builder


def damage(path: Path, remedy: str = "") -> contextlib.AbstractContextManager[None]:
    """`files.damage`, of protobuf's errors too."""
    return files.damage(path, ParseError, remedy=remedy)
