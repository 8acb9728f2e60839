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
import numpy as np

from envs.actions import MODES
from lorasp_jax.base.files import as_value_error, check_local, check_memory, check_regular
from lorasp_jax.base.writing import atomic_file

Array = jax.Array | np.ndarray

_FORMAT = "envs-episodes-1"
SHARED = ("task", "robot", "control_dt", "physics_dt", "actions", "instructions")
"""Fields that must be equal in order to concatenate episodes."""
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
    """E episodes of one task and a robot with J joints, padded to T control steps.

    Attributes:
        image: camera name -> uint8 `[E, T, H, W, 3]`, observed before each action.
        state: f32 `[E, T, J + 1]` joint angles [rad] and gripper opening [m], measured before each
            action.
        action: f32 `[E, T, A]` commands; by default A = J + 1 joint targets [rad] and gripper
            opening [m].
        length: int32 `[E]` number of valid steps, 1 to T; the rest is padding.
        instruction: int32 `[E]` index into `instructions`.
        instructions: phrasings of the task.
        task, robot: their names.
        control_dt: time between two actions [s].
        physics_dt: time step of the simulation [s]; 0 for recordings of real robots.
        attempted: number of attempts; these episodes are the successful ones.
        actions: action mode (see `envs.actions`).
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
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        arrays |= {_IMAGE + name: images for name, images in self.image.items()}
        fields = [f"{name}={_dtype_and_shape(array)}" for name, array in arrays.items()]
        fields += [f"{name}={getattr(self, name)!r}" for name in _METADATA]
        return f"Episodes({', '.join(fields)})"

    @property
    def num_episodes(self) -> int:
        """Number of episodes, E."""
        return self.state.shape[0]

    @property
    def num_steps(self) -> int:
        """Total number of valid control steps."""
        return int(np.sum(self.length))

    def select(self, indices: Sequence[int] | Array) -> Self:
        """Select episodes by index, in this order."""
        return jax.tree.map(lambda x: x[np.asarray(indices)], self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an uncompressed .npz file, replacing an existing one atomically.

        Raises:
            ValueError: the arrays are inconsistent.
        """
        self.validate()
        check_local(path := Path(path))
        metadata = {name: getattr(self, name) for name in _METADATA}
        header = json.dumps({"format": _FORMAT, **metadata}).encode()
        arrays: dict[str, Any] = {name: np.asarray(getattr(self, name)) for name in _ARRAYS}
        arrays |= {_IMAGE + name: np.asarray(images) for name, images in self.image.items()}
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, header=np.frombuffer(header, np.uint8), **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, control_dt: float | None = None) -> Self:
        """Read a file written by `save` into host memory.

        Args:
            path: the file.
            control_dt: required control period [s]; None: any.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: the file is damaged, or has another format or control period.
        """
        arrays = _read(Path(path))
        try:
            metadata = {"actions": "joint"}  # for files older than this field
            metadata |= json.loads(arrays.pop("header").tobytes())
            if metadata.pop("format") != _FORMAT:
                raise KeyError("format")
        except (KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(f"{path} is an .npz file without a valid {_FORMAT} header") from error
        missing = {*_ARRAYS} - arrays.keys() | {*_METADATA} - metadata.keys()
        if missing:
            raise ValueError(f"{path} lacks {', '.join(sorted(missing))}")
        image: Any = {k.removeprefix(_IMAGE): v for k, v in arrays.items() if k.startswith(_IMAGE)}
        fields: dict[str, Any] = {name: arrays[name] for name in _ARRAYS}
        try:
            metadata["instructions"] = tuple(metadata["instructions"])
            episodes = cls(image=image, **fields, **{name: metadata[name] for name in _METADATA})
            episodes.validate()
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} is invalid: {error}") from error
        if control_dt is not None and abs(episodes.control_dt - control_dt) > 1e-9:
            raise ValueError(
                f"{path} must have control_dt {control_dt} s, got {episodes.control_dt} s"
            )
        return episodes

    def validate(self) -> None:
        """Raise a ValueError if the arrays are inconsistent or a value is not finite."""
        self.validate_numbers()
        steps = self.state.shape[:2]
        if not self.image:
            raise ValueError("image must have at least one camera")
        for name, images in self.image.items():
            check_camera(name)
            if images.shape[:2] != steps or images.shape[4:] != (3,) or images.dtype != np.uint8:
                raise ValueError(
                    f"image {name!r} must be uint8 [{steps[0]}, {steps[1]}, H, W, 3], "
                    f"got {images.dtype} {list(images.shape)}"
                )

    def validate_numbers(self) -> None:
        """Run the checks of `validate`, except those of images."""
        self._validate_metadata()
        if self.state.ndim != 3 or not self.state.size:
            raise ValueError(f"state must have shape [E, T, J + 1], got {self.state.shape}")
        steps = self.state.shape[:2]
        self._validate_action()
        for name, low, high in (
            ("length", 1, steps[1]),
            ("instruction", 0, len(self.instructions) - 1),
        ):
            values = np.asarray(getattr(self, name))
            if values.shape != steps[:1] or not np.issubdtype(values.dtype, np.integer):
                raise ValueError(
                    f"{name} must be integers of shape {steps[:1]}, got {values.dtype} of shape "
                    f"{values.shape}"
                )
            if values.min() < low or values.max() > high:
                raise ValueError(
                    f"{name} must be {low} to {high}, got {values.min()} to {values.max()}"
                )

    def _validate_metadata(self) -> None:
        texts = {"task": self.task, "robot": self.robot, "actions": self.actions}
        texts |= {f"instruction {i}": text for i, text in enumerate(self.instructions)}
        for name, text in texts.items():
            if not isinstance(text, str):
                raise ValueError(f"{name} must be a string, got {text!r}")
        for name in ("control_dt", "physics_dt"):
            time = getattr(self, name)
            if not isinstance(time, numbers.Real) or not 0 <= float(time) < math.inf:
                raise ValueError(f"{name} must be a finite time in s, at least 0, got {time!r}")
        if not self.control_dt:
            raise ValueError("control_dt must be above 0 s")

    def _validate_action(self) -> None:
        if self.actions not in MODES:
            raise ValueError(f"actions must be one of {', '.join(MODES)}, got {self.actions!r}")
        expected = (
            (*self.state.shape[:2], 7) if self.actions == "end_effector" else self.state.shape
        )
        if self.action.shape != expected:
            raise ValueError(f"action must have shape {expected}, got {self.action.shape}")
        for name in ("state", "action"):
            if getattr(self, name).dtype != np.float32:
                raise ValueError(f"{name} must be float32, got {getattr(self, name).dtype}")
            wrong = np.argwhere(~np.isfinite(np.asarray(getattr(self, name))))
            if len(wrong):
                episode, step, dimension = map(int, wrong[0])
                raise ValueError(
                    f"{name} is not finite in dimension {dimension} at step {step} of episode "
                    f"{episode}"
                )


def check_camera(name: str) -> None:
    """Raise a ValueError if a camera's name cannot be part of a file name."""
    if not _CAMERA.fullmatch(name):
        raise ValueError(
            f"invalid camera name {name[:80]!r}: use letters, digits, - _ . and spaces"
        )


def concatenate(parts: Sequence[Episodes]) -> Episodes:
    """Concatenate episodes of one task and robot in host memory, padded to the longest.

    Raises:
        ValueError: `parts` is empty, or its episodes differ in image shapes or a field of `SHARED`.
    """
    if not parts:
        raise ValueError("there is nothing to concatenate: parts is empty")
    for name in SHARED:
        values = {getattr(part, name) for part in parts}
        if len(values) > 1:
            raise ValueError(f"all parts must have the same {name}, got {sorted(values)}")
    shapes = {tuple(sorted((k, v.shape[2:]) for k, v in part.image.items())) for part in parts}
    if len(shapes) > 1:
        raise ValueError(f"all parts must have the same image shapes, got {sorted(shapes)}")
    steps = max(part.state.shape[1] for part in parts)

    def join(*arrays: Array) -> np.ndarray:
        return np.concatenate([_pad(x, steps) for x in arrays])

    attempted = sum(part.attempted for part in parts)
    same = [dataclasses.replace(part, attempted=attempted) for part in parts]
    return jax.tree.map(join, *same)


def _dtype_and_shape(array: Any) -> str:
    """Describe an array or tracer, or return the `repr` of what a tree map put in its place."""
    return f"{array.dtype}{list(array.shape)}" if hasattr(array, "dtype") else repr(array)


def _pad(array: Array, steps: int) -> Array:
    """Pad `[E, T, ...]` with zeros to T = `steps`; return `[E]` unchanged."""
    if array.ndim == 1 or array.shape[1] == steps:
        return array
    return np.pad(array, [(0, 0), (0, steps - array.shape[1])] + [(0, 0)] * (array.ndim - 2))


def _read(path: Path) -> dict[str, np.ndarray]:
    check_regular(path)
    with as_value_error(path), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        check_memory(sum(member.file_size for member in members), path)
        return {m.filename.removesuffix(".npy"): _array(archive, m) for m in members}


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Read one array after checking its size, since NumPy trusts the size in its header."""
    with archive.open(member) as file:
        if (version := np.lib.format.read_magic(file)) not in _HEADERS:
            raise ValueError(f"{member.filename} has unsupported .npy version {version}")
        shape, _, dtype = _HEADERS[version](file)
        if math.prod(shape) * dtype.itemsize != member.file_size - file.tell():
            raise ValueError(f"the size of {member.filename} does not match {dtype} {list(shape)}")
    with archive.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)
