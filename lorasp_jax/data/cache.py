"""A flat cache of steps on disk: what training reads of a dataset, made from it once.

    cache.write([open_source("my_dataset")], "my_cache", lambda done, total: None)
    steps = cache.Cache("my_cache").steps

A folder of plain .npy files that are mapped into memory, raw pictures among them; cache.json with
what all episodes share and the files' checksums; statistics.json. Pictures have a checksum each, in
files of their own, and are compared when they are first read. A batch is one gather per file.
Measured on two cores, 64 windows of two cameras at a time, shuffled: 128 x 128 pixels 37,000
windows/s, 224 x 168 18,000; from array_record files of raw pictures 6,500 and 3,800.
"""

import json
import math
import os
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Self

import numpy as np

from envs.datasets.episodes import SHARED, Episodes, check_camera
from envs.datasets.files import damage, read_json, read_text
from envs.datasets.locks import locked
from envs.datasets.writing import creating
from lorasp_jax.data.batches import Steps
from lorasp_jax.data.cache_writer import Column, mapped
from lorasp_jax.data.pictures import Pictures, checksum
from lorasp_jax.data.source import Progress, Source
from lorasp_jax.policies.statistics import Statistics
from lorasp_jax.storage.digest import DIGEST, sealed, unsealed
from lorasp_jax.storage.json_values import check

FORMAT = "lorasp-cache-1"
HEADER, STATISTICS = "cache.json", "statistics.json"
ROWS = ("state", "action", "length", "instruction", "task")
"""Files beside those of the cameras: of steps, of steps, of episodes, of episodes, of episodes."""
_IMAGE, _CHECKSUM = "image_", "crc32_"
_KIND = {"state": np.float32, "action": np.float32, "image": np.uint8, "crc32": np.uint32}
FACTS = tuple(name for name in SHARED if name not in ("task", "instructions"))
"""What the episodes of a cache have in common."""
_KINDS: dict[str, Any] = {
    "format": str,
    **dict.fromkeys(("robot", "actions"), str),
    **dict.fromkeys(("control_dt", "physics_dt"), float),
    **dict.fromkeys(("steps", "numbers"), int),
    "tasks": [str],
    "instructions": [str],
    "cameras": {str: (int, int)},
    "crc32": {str: int},
}
_KNOWN = {*_KINDS, DIGEST}


def write(
    sources: Sequence[Source],
    path: str | os.PathLike[str],
    progress: Progress,
    waiting: Callable[[], None] | None = None,
) -> None:
    """Writes a cache folder, which is there only when all of it is.

    Args:
        sources: datasets of one robot with pictures of one size; they are not changed.
        path: the folder to make.
        progress: told of the steps.
        waiting: called once if another process is writing this folder; it is then waited for, and
            what it wrote is kept if it is of these datasets. None: that is an error.

    Raises:
        ValueError: the path exists already, or is another process's; or an episode is not as the
            others or damaged.
        OSError: there is no room for it.
    """
    path, total = Path(path), sum(source.num_steps for source in sources)
    there = path.exists()
    with locked(path, waiting):
        if path.exists() and not there:
            _check(Cache(path), sources, total)
            return
        kind = _facts(sources[0].episode(0)) if sources[1:] else {}
        for source in sources[1:]:  # now, not when hours of the first one's pictures are read
            _check_kind(kind, source.episode(0))
        with creating(path) as folder, Writer(folder) as writer, ThreadPoolExecutor(1) as reader:
            for episode in _ahead(sources, reader):
                writer.append(episode)
                progress(writer.num_steps, total)


def _check(found: "Cache", sources: Sequence[Source], steps: int) -> None:
    """Raise ValueError unless size and first episode of a cache are as of these datasets."""
    first, wanted = found.episode(0), sources[0].episode(0)
    length = int(wanted.length[0])
    same = found.num_steps == steps and _facts(first) == _facts(wanted)
    for name in ("state", "action"):
        same = same and np.array_equal(getattr(first, name), getattr(wanted, name)[:, :length])
    if not same:
        raise ValueError(f"another process has written {found.path}, of something else")


def _ahead(sources: Sequence[Source], reader: ThreadPoolExecutor) -> Iterator[Episodes]:
    """All episodes, each read while the one before is written: two are in memory at a time."""
    coming = None
    for source in sources:
        for number in range(len(source)):
            ready = coming and coming.result()
            coming = reader.submit(source.episode, number)
            if ready:
                yield ready
    if coming:
        yield coming.result()


class Writer:
    """Writes a cache episode by episode; as a context it is complete where nothing was raised."""

    def __init__(self, folder: Path) -> None:
        """Begins in a folder that is there."""
        self.num_steps: int = 0
        self._folder, self._facts = folder, {}
        self._tasks: list[str] = []
        self._instructions: list[str] = []
        self._columns: dict[str, Column] = {}

    def __enter__(self) -> Self:
        """Nothing is open yet."""
        return self

    def __exit__(self, kind: Any, *_: Any) -> None:
        """Closes all files; describes them where nothing was raised."""
        for column in self._columns.values():
            column.close()
        if kind is not None:
            return
        if not self.num_steps:
            raise ValueError("there is no episode to write")
        checksums = [name for name in self._columns if name.startswith(_CHECKSUM)]
        rows = {name: np.load(self._folder / f"{name}.npy") for name in (*ROWS, *checksums)}
        if self._facts["actions"] == "joint":
            width, every = rows["state"].shape[1], np.ones(self.num_steps, bool)
            state, action = rows["state"], rows["action"]
            found = Statistics.measure(state, action, every, slots=range(width), dim=width)
            (self._folder / STATISTICS).write_text(found.to_json())
        facts = {"format": FORMAT, **self._facts, "steps": self.num_steps}
        facts |= {"tasks": self._tasks, "instructions": self._instructions}
        facts["crc32"] = {name: zlib.crc32(array.data) for name, array in rows.items()}
        (self._folder / HEADER).write_text(json.dumps(sealed(facts), indent=1))

    def append(self, episode: Episodes) -> None:
        """Adds an `Episodes` of one.

        Raises:
            ValueError: its arrays do not fit one another or the episodes before.
        """
        episode.validate()
        self._facts = self._facts or _facts(episode)
        _check_kind(self._facts, episode)
        length = int(episode.length[0])
        phrase = episode.instructions[int(episode.instruction[0])]
        lists = (self._tasks, [episode.task]), (self._instructions, episode.instructions)
        for known, new in lists:
            known += [text for text in new if text not in known]
        steps = {"state": episode.state, "action": episode.action}
        steps |= {_IMAGE + name: picture for name, picture in episode.image.items()}
        for name, array in steps.items():
            self._extend(name, np.asarray(array)[0, :length])
        for name, pictures in episode.image.items():
            found = [checksum(picture) for picture in np.asarray(pictures)[0, :length]]
            self._extend(_CHECKSUM + name, np.array(found, np.uint32))
        one = {"length": length, "instruction": self._instructions.index(phrase)}
        one["task"] = self._tasks.index(episode.task)
        for name, value in one.items():
            self._extend(name, np.array([value], np.int32))
        self.num_steps += length

    def _extend(self, name: str, rows: np.ndarray) -> None:
        if name not in self._columns:
            self._columns[name] = Column(self._folder / f"{name}.npy", rows)
        self._columns[name].append(rows)


def _check_kind(facts: dict[str, Any], episode: Episodes) -> None:
    """Raise ValueError unless these are the facts of an episode."""
    for name, value in _facts(episode).items():
        if value != facts[name]:
            raise ValueError(
                f"a cache holds episodes of one kind, but {name} is {facts[name]!r} in the first "
                f"one and {value!r} in one of {episode.task}"
            )


def _facts(episode: Episodes) -> dict[str, Any]:
    """What all episodes of a cache must have in common."""
    facts = {name: getattr(episode, name) for name in FACTS}
    facts["cameras"] = {name: list(x.shape[2:4]) for name, x in sorted(episode.image.items())}
    facts["numbers"] = episode.state.shape[2]
    return facts


class Cache:
    """A cache on disk, mapped into memory.

    Attributes:
        kind: the format's name.
        path: the folder.
        facts: cache.json: robot, tasks, instructions, control_dt and so on.
        cameras: name -> height and width.
        statistics: of states and actions, in the robot's own numbers; None where actions are of
            another kind than states.
    """

    kind = "cache"

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Opens a cache.

        Raises:
            ValueError: it is not there, damaged, or of another format.
        """
        self.path: Path = Path(path)
        header = self.path / HEADER
        if not header.is_file():
            raise ValueError(f"{path} is not a cache: there is no {HEADER} in it")
        with damage(header):
            self.facts: dict[str, Any] = read_json(header, self.path)
            if DIGEST in self.facts:
                self.facts = unsealed(self.facts)
            if unknown := sorted(self.facts.keys() - _KNOWN):
                raise ValueError(f"it has a field {unknown[0]!r}")
            if self.facts["format"] != FORMAT:
                raise ValueError(f"it is of format {self.facts['format']!r}, not {FORMAT!r}")
            check(self.facts, _KINDS)
            self.cameras: dict[str, list[int]] = self.facts["cameras"]
            self.control_dt: float = self.facts["control_dt"]
            self.num_steps: int = self.facts["steps"]
            self.instructions: tuple[str, ...] = tuple(self.facts["instructions"])
            width = self.facts["numbers"]
            if not (0 < self.control_dt < math.inf and width > 0):
                raise ValueError(f"control_dt is {self.control_dt} and numbers {width}")
            sizes = {name: tuple(size) for name, size in self.cameras.items()}
            for name in sizes:
                check_camera(name)
            if not self.facts["crc32"].keys() >= {*ROWS}:
                raise ValueError("it lacks checksums")
        self._images: dict[str, Any] = {
            name: self._pictures(name, size) for name, size in sizes.items()
        }
        rows = {"state": (self.num_steps, width), "action": (self.num_steps, None)}
        self._columns = {name: self._mapped(name, shape) for name, shape in rows.items()}
        length = self._columns["length"] = self._mapped("length", (None,))
        self._columns |= {name: self._mapped(name, length.shape) for name in ROWS[3:]}
        self._end = np.cumsum(length, dtype=np.int64)
        if not len(length) or length.min() < 1 or self._end[-1] != self.num_steps:
            raise ValueError(f"{path} has episodes of {length} steps, not {self.num_steps} in all")
        for name, texts in (("task", self.facts["tasks"]), ("instruction", self.instructions)):
            low, high = self._columns[name].min(), self._columns[name].max()
            if low < 0 or high >= len(texts):
                raise ValueError(f"{path} is damaged (it has {name} {low} to {high})")
        with damage(header):
            self.episode(0, ()).validate_numbers()
            for name in ("state", "action"):
                if not np.isfinite(self._columns[name]).all():
                    raise ValueError(f"{name} holds numbers that are not finite")
        self.statistics: Statistics | None = self._statistics()

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self._end)

    @property
    def steps(self) -> Steps:
        """All steps, in files: indexing reads them."""
        length = self._columns["length"]
        return Steps(
            image={**self._images},
            state=self._columns["state"],
            action=self._columns["action"],
            end=np.repeat(self._end, length).astype(np.int32),
            instruction=np.repeat(self._columns["instruction"], length),
        )

    def episode(self, number: int, cameras: Sequence[str] | None = None) -> Episodes:
        """One episode, with the pictures of these cameras; None: all."""
        here = slice(self._end[number] - self._columns["length"][number], self._end[number])
        one = slice(number, number + 1)
        wanted = self.cameras if cameras is None else cameras
        return Episodes(
            image={name: self._images[name][here][None] for name in wanted},
            state=self._columns["state"][None, here],
            action=self._columns["action"][None, here],
            length=self._columns["length"][one],
            instruction=self._columns["instruction"][one],
            instructions=self.instructions,
            task=self.facts["tasks"][self._columns["task"][number]],
            attempted=1,
            **{name: self.facts[name] for name in FACTS},
        )

    def _mapped(self, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
        """An array in a file, whose shape must be this one where it is given."""
        path, kind = self.path / f"{name}.npy", _KIND.get(name.partition("_")[0], np.int32)
        return mapped(path, kind, shape, self.facts["crc32"].get(name))

    def _pictures(self, name: str, size: Sequence[int]) -> np.ndarray | Pictures:
        """Those of a camera; caches of old have no checksums of them."""
        array = self._mapped(_IMAGE + name, (self.num_steps, *size, 3))
        if _CHECKSUM + name not in self.facts["crc32"]:
            return array
        checksums = self._mapped(_CHECKSUM + name, (None,))
        return Pictures(self.path / f"{_IMAGE}{name}.npy", array, checksums)

    def _statistics(self) -> Statistics | None:
        path = self.path / STATISTICS
        if self.facts["actions"] != "joint":
            return None
        with damage(path):
            return Statistics.from_json(read_text(path, self.path))
