"""Recorded episodes: batched arrays in memory, one .npz file on disk."""

import dataclasses
import functools
import json
import math
import numbers
import os
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np

from envs.actions import MODES
from envs.datasets.files import check_local, check_memory, damage, regular
from envs.datasets.writing import atomic_file

Array = jax.Array | np.ndarray

_FORMAT = "envs-episodes-1"
SHARED = ("task", "robot", "control_dt", "physics_dt", "actions", "instructions")
"""What episodes must have in common to be joined."""
_ARRAYS = ("state", "action", "length", "instruction")
_METADATA = (*SHARED, "attempted")
_IMAGE = "image/"
_CAMERA = re.compile(r"[\w-][\w .-]{0,99}")
_HEADERS: Any = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


@functools.partial(
    jax.tree_util.register_dataclass, data_fields=("image", *_ARRAYS), meta_fields=_METADATA
)
@dataclasses.dataclass(frozen=True)
class Episodes:
    """E episodes of one task and robot, padded to T control steps.

    Attributes:
        image: camera name -> uint8 `[E, T, H, W, 3]`, before each action.
        state: f32 `[E, T, J + 1]` measured joint angles [rad] and gripper opening [m], before each
            action.
        action: f32 `[E, T, A]` commanded; by default A = J + 1 joint targets [rad] and gripper
            opening [m].
        length: int32 `[E]` steps that count, 1 to T; what follows them is padding.
        instruction: int32 `[E]` index into `instructions`.
        instructions: phrasings of the task.
        task: name of the task.
        robot: name of the robot.
        control_dt: time between two actions [s].
        physics_dt: time step of the simulation [s]; 0 where nothing was simulated.
        attempted: episodes tried to get these; the others failed.
        actions: what an action means, see `envs.actions`.
    """

    image: dict[str, Array]
    state: Array
    action: Array
    length: Array
    instruction: Array
    instructions: tuple[str, ...]
    task: str
    robot: str
    control_dt: float
    physics_dt: float
    attempted: int
    actions: str = "joint"

    def __repr__(self) -> str:
        """Facts, and of arrays the types and shapes."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        arrays |= {_IMAGE + name: picture for name, picture in self.image.items()}
        shown = [f"{name}={_short(array)}" for name, array in arrays.items()]
        shown += [f"{name}={getattr(self, name)!r}" for name in _METADATA]
        return f"Episodes({', '.join(shown)})"

    @property
    def num_episodes(self) -> int:
        """E."""
        return self.state.shape[0]

    @property
    def num_steps(self) -> int:
        """Control steps that count, over all episodes."""
        return int(np.sum(self.length))

    def select(self, indices: Sequence[int] | Array) -> Self:
        """The episodes with these numbers, in this order."""
        return jax.tree.map(lambda x: x[np.asarray(indices)], self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes one uncompressed .npz file; an existing file is replaced only when all is written.

        Raises:
            ValueError: if the arrays do not fit one another.
        """
        self.validate()
        check_local(path := Path(path))
        facts = {name: getattr(self, name) for name in _METADATA}
        header = json.dumps({"format": _FORMAT, **facts}).encode()
        arrays: dict[str, Any] = {name: np.asarray(getattr(self, name)) for name in _ARRAYS}
        arrays |= {_IMAGE + name: np.asarray(picture) for name, picture in self.image.items()}
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as unfinished, open(unfinished, "wb") as file:
            np.savez(file, header=np.frombuffer(header, np.uint8), **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, control_dt: float | None = None) -> Self:
        """Reads what `save` wrote, into host memory.

        Args:
            path: the file.
            control_dt: if given, the control period [s] that the episodes must have.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is damaged, not of this format, or of another control period.
        """
        arrays = _read(Path(path))
        try:
            facts = {"actions": "joint"}  # the only ones there were before it was written down
            facts |= json.loads(arrays.pop("header").tobytes())
            if facts.pop("format") != _FORMAT:
                raise KeyError("format")
        except (KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(f"{path} is an .npz file, but holds no {_FORMAT} header") from error
        missing = {*_ARRAYS} - arrays.keys() | {*_METADATA} - facts.keys()
        if missing:
            raise ValueError(f"{path} lacks {', '.join(sorted(missing))}")
        image: Any = {k.removeprefix(_IMAGE): v for k, v in arrays.items() if k.startswith(_IMAGE)}
        fields: dict[str, Any] = {name: arrays[name] for name in _ARRAYS}
        try:
            facts["instructions"] = tuple(facts["instructions"])
            episodes = cls(image=image, **fields, **{name: facts[name] for name in _METADATA})
            episodes.validate()
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} is not valid: {error}") from error
        if control_dt is not None and abs(episodes.control_dt - control_dt) > 1e-9:
            raise ValueError(
                f"{path} has control_dt {episodes.control_dt} s, but {control_dt} s is needed"
            )
        return episodes

    def validate(self) -> None:
        """Raises a ValueError if the arrays do not fit one another or a number is not finite."""
        self.validate_numbers()
        steps = self.state.shape[:2]
        if not self.image:
            raise ValueError("image holds no camera, but at least one is needed")
        for name, picture in self.image.items():
            check_camera(name)
            if picture.shape[:2] != steps or picture.shape[4:] != (3,) or picture.dtype != np.uint8:
                raise ValueError(
                    f"image {name!r} must be uint8 [{steps[0]}, {steps[1]}, H, W, 3], "
                    f"not {picture.dtype} {list(picture.shape)}"
                )

    def validate_numbers(self) -> None:
        """`validate` without the pictures."""
        self._validate_facts()
        if self.state.ndim != 3 or not self.state.size:
            raise ValueError(f"state must have shape [E, T, J + 1], not {self.state.shape}")
        steps = self.state.shape[:2]
        self._validate_action()
        for name, low, high in (
            ("length", 1, steps[1]),
            ("instruction", 0, len(self.instructions) - 1),
        ):
            values = np.asarray(getattr(self, name))
            if values.shape != steps[:1] or not np.issubdtype(values.dtype, np.integer):
                raise ValueError(
                    f"{name} must be integers of shape {steps[:1]}, not {values.shape}"
                )
            if values.min() < low or values.max() > high:
                raise ValueError(
                    f"{name} must lie in {low} to {high}, not {values.min()} to {values.max()}"
                )

    def _validate_facts(self) -> None:
        texts = {"task": self.task, "robot": self.robot, "actions": self.actions}
        texts |= {f"instruction {i}": text for i, text in enumerate(self.instructions)}
        for name, text in texts.items():
            if not isinstance(text, str):
                raise ValueError(f"{name} must be a text, not {text!r}")
        for name in ("control_dt", "physics_dt"):
            time = getattr(self, name)
            if not isinstance(time, numbers.Real) or not 0 <= float(time) < math.inf:
                raise ValueError(f"{name} must be a time in s, not {time!r}")
        if not self.control_dt:
            raise ValueError("control_dt must be above 0 s")

    def _validate_action(self) -> None:
        if self.actions not in MODES:
            raise ValueError(f"actions must be one of {', '.join(MODES)}, not {self.actions!r}")
        expected = (
            (*self.state.shape[:2], 7) if self.actions == "end_effector" else self.state.shape
        )
        if self.action.shape != expected:
            raise ValueError(f"action must have shape {expected}, not {self.action.shape}")
        for name in ("state", "action"):
            if getattr(self, name).dtype != np.float32:
                raise ValueError(f"{name} must be float32, not {getattr(self, name).dtype}")
            wrong = np.argwhere(~np.isfinite(np.asarray(getattr(self, name))))
            if len(wrong):
                episode, step, number = map(int, wrong[0])
                raise ValueError(
                    f"{name} is not finite in number {number} at step {step} of episode {episode}"
                )


def check_camera(name: str) -> None:
    """Raises a ValueError unless files can be called after a camera of this name."""
    if not _CAMERA.fullmatch(name):
        raise ValueError(
            f"a camera is called {name[:80]!r}: valid are letters, digits, - _ . and spaces"
        )


def concatenate(parts: Sequence[Episodes]) -> Episodes:
    """All episodes of several collections of one task and robot, padded to the longest.

    Raises:
        ValueError: if there are none, or they differ in more than length and number.
    """
    if not parts:
        raise ValueError("there is nothing to concatenate: parts is empty")
    for name in SHARED:
        values = {getattr(part, name) for part in parts}
        if len(values) > 1:
            raise ValueError(f"only episodes of one {name} can be joined, not {sorted(values)}")
    shapes = {tuple(sorted((k, v.shape[2:]) for k, v in part.image.items())) for part in parts}
    if len(shapes) > 1:
        raise ValueError(f"only episodes of equal pictures can be joined, not {sorted(shapes)}")
    steps = max(part.state.shape[1] for part in parts)

    def join(*arrays: Array) -> Array:
        xp = np if all(isinstance(x, np.ndarray) for x in arrays) else jnp
        return xp.concatenate([_padded(xp, x, steps) for x in arrays])

    attempted = sum(part.attempted for part in parts)
    same = [dataclasses.replace(part, attempted=attempted) for part in parts]
    return jax.tree.map(join, *same)


def _short(array: Any) -> str:
    """Type and shape, of a tracer too; what a tree map has put in its place, as it is."""
    return f"{array.dtype}{list(array.shape)}" if hasattr(array, "dtype") else repr(array)


def _padded(xp: Any, array: Array, steps: int) -> Array:
    """`[E, ...]` as it is, `[E, T, ...]` with zeros up to `steps`."""
    if array.ndim == 1 or array.shape[1] == steps:
        return array
    return xp.pad(array, [(0, 0), (0, steps - array.shape[1])] + [(0, 0)] * (array.ndim - 2))


def _read(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an .npz file."""
    regular(path)
    with damage(path), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        check_memory(sum(member.file_size for member in members), path)
        return {m.filename.removesuffix(".npy"): _array(archive, m) for m in members}


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """One array, of which there are as many bytes as its header says: NumPy would not ask."""
    with archive.open(member) as file:
        if (version := np.lib.format.read_magic(file)) not in _HEADERS:
            raise ValueError(f"{member.filename} is of version {version}")
        shape, _, dtype = _HEADERS[version](file)
        if math.prod(shape) * dtype.itemsize != member.file_size - file.tell():
            raise ValueError(f"{member.filename} does not hold {dtype} {list(shape)}")
    with archive.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)
