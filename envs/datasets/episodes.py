"""Recorded episodes: batched arrays in memory, and in the cache of a run."""

import dataclasses
import functools
import json
import math
import numbers
import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self, TypeVar

import jax
import numpy as np

from envs.names import MODES
from lorasp_jax.base.files import as_value_error
from lorasp_jax.base.writing import atomic_file

Array = jax.Array | np.ndarray
T = TypeVar("T")

SHARED = ("task", "robot", "control_dt", "physics_dt", "actions", "instructions")
"""Fields that must be equal in order to concatenate episodes."""
_ARRAYS = ("state", "action", "length", "instruction")
_LABELS = ("success", "corrected")
_METADATA = (*SHARED, "attempted")
_IMAGE = "image/"
_CAMERA = re.compile(r"[\w-][\w .-]{0,99}")


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("image", *_ARRAYS, *_LABELS),
    meta_fields=_METADATA,
)
@dataclasses.dataclass(frozen=True)
class Episodes:
    """E episodes of one task and a robot with J joints, padded to T control steps.

    Attributes:
        image: camera name -> uint8 `[E, T, H, W, 3]`, observed before each action.
        state: f32 `[E, T, J + 1]` joint angles [rad] and gripper opening [m], measured before each
            action.
        action: f32 `[E, T, A]` commands; by default A = J + 1 joint targets [rad] and gripper
            opening [m]. Recordings may have another A.
        length: int32 `[E]` number of valid steps, 1 to T; the rest is padding.
        instruction: int32 `[E]` index into `instructions`.
        instructions: phrasings of the task.
        task, robot: their names.
        control_dt: time between two actions [s].
        physics_dt: time step of the simulation [s]; 0 for recordings of real robots.
        attempted: number of attempts; without labels, these episodes are the successful ones.
        actions: action mode (see `envs.actions`).
        success: int32 `[E]`, 1 success, 0 failure, -1 nobody said; None: no labels.
        corrected: bool `[E, T]`, steps in which a person acted in place of a policy; None: none.
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
    success: Array | None = None
    corrected: Array | None = None

    def __repr__(self) -> str:
        arrays = {name: getattr(self, name) for name in _ARRAYS} | self.labels
        arrays |= {_IMAGE + name: images for name, images in self.image.items()}
        fields = [f"{name}={_dtype_and_shape(array)}" for name, array in arrays.items()]
        fields += [f"{name}={getattr(self, name)!r}" for name in _METADATA]
        return f"Episodes({', '.join(fields)})"

    @property
    def labels(self) -> dict[str, Array]:
        """`success` and `corrected`, those that are not None."""
        labels = {name: getattr(self, name) for name in _LABELS}
        return {name: array for name, array in labels.items() if array is not None}

    @property
    def num_episodes(self) -> int:
        """Number of episodes, E."""
        return self.state.shape[0]

    @property
    def num_steps(self) -> int:
        """Total number of valid control steps."""
        return int(np.sum(self.length))

    @property
    def phrases(self) -> list[str]:
        """The instruction of each episode, `[E]`."""
        return [self.instructions[int(index)] for index in self.instruction]

    def select(self, indices: Sequence[int] | Array) -> Self:
        """Select episodes by index, in this order."""
        return jax.tree.map(lambda x: x[np.asarray(indices)], self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an uncompressed .npz file, replacing an existing one atomically.

        Raises:
            ValueError: the arrays are inconsistent.
        """
        self.validate()
        path = Path(path)
        header = json.dumps({name: getattr(self, name) for name in _METADATA}).encode()
        named = {name: getattr(self, name) for name in _ARRAYS} | self.labels
        arrays: dict[str, Any] = {name: np.asarray(array) for name, array in named.items()}
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
            ValueError: the file is missing or damaged, or has another format or control period.
        """
        with as_value_error(path := Path(path)):
            with path.open("rb") as file, np.load(file) as archive:
                if len(set(archive.files)) < len(archive.files):
                    raise ValueError("two of its arrays have the same name")
                fields: dict[str, Any] = dict(archive)
            header = json.loads(fields.pop("header").tobytes())
            fields |= {name: header[name] for name in _METADATA}
            fields["instructions"] = tuple(fields["instructions"])
            images = [name for name in fields if name.startswith(_IMAGE)]
            image = {name.removeprefix(_IMAGE): fields.pop(name) for name in images}
            episodes = cls(image=image, **fields)
            episodes.validate()
            if control_dt is not None and abs(episodes.control_dt - control_dt) > 1e-9:
                raise ValueError(f"its control_dt is {episodes.control_dt}, not {control_dt} s")
        return episodes

    def validate(self) -> None:
        """Raise a ValueError if the arrays are inconsistent or a value is not finite."""
        self.validate_numbers()
        for name in self.image:
            check_camera(name)
        _check(self._image_rules())

    def validate_numbers(self) -> None:
        """Run the checks of `validate`, except those of images."""
        _check(self._rules())

    def _image_rules(self) -> Iterator[tuple[bool, str]]:
        steps = self.state.shape[:2]
        yield bool(self.image), "image must have at least one camera"
        for name, images in self.image.items():
            is_image = images.shape[4:] == (3,) and images.dtype == np.uint8
            got = _dtype_and_shape(images)
            yield (
                is_image and images.shape[:2] == steps,
                (f"image {name!r} must be uint8 {[*steps]} + [H, W, 3], got {got}"),
            )

    def _rules(self) -> Iterator[tuple[bool, str]]:
        """Yield what must hold, each after what it depends on."""
        yield self.actions in MODES, f"actions must be one of {', '.join(MODES)}"
        texts = {"task": self.task, "robot": self.robot, "instructions": "".join(self.instructions)}
        for name, text in texts.items():
            yield isinstance(text, str), f"{name} must be text, got {text!r}"
        for name in ("control_dt", "physics_dt"):
            time = getattr(self, name)
            valid = isinstance(time, numbers.Real) and 0 <= float(time) < math.inf
            yield (
                valid and (float(time) > 0 or name == "physics_dt"),
                f"{name} is {time!r}, not a time in s",
            )
        yield self.state.ndim == 3 and self.state.size > 0, "state must have shape [E, T, J + 1]"
        episodes, steps, width = self.state.shape
        if self.actions == "end_effector":
            width = 7
        elif self.physics_dt == 0 and self.action.ndim == 3:  # recordings: of any length
            width = max(1, self.action.shape[2])
        shape = (episodes, steps, width)
        yield self.action.shape == shape, f"action must have shape {shape}, got {self.action.shape}"
        for name in ("state", "action"):
            values = np.asarray(getattr(self, name))
            yield values.dtype == np.float32, f"{name} must be float32, got {values.dtype}"
            wrong = np.argwhere(~np.isfinite(values))
            number = "episode {0}, " if episodes > 1 else ""
            at = f"{number}step {{1}}, dimension {{2}}".format(*wrong[0]) if len(wrong) else ""
            yield not at, f"{name} is not finite at {at}"
        for name, low, high in (
            ("length", 1, steps),
            ("instruction", 0, len(self.instructions) - 1),
        ):
            values = np.asarray(getattr(self, name))
            integers = values.shape == (episodes,) and np.issubdtype(values.dtype, np.integer)
            in_range = integers and values.min() >= low and values.max() <= high
            yield in_range, f"{name} must be {episodes} integers from {low} to {high}, got {values}"
        for name, array in self.labels.items():
            values = np.asarray(array)
            kind, size = (
                (np.bool_, (episodes, steps)) if name == "corrected" else (np.int32, (episodes,))
            )
            valid = values.shape == size and values.dtype == kind
            valid = valid and bool(np.isin(values, (-1, 0, 1)).all())
            got = _dtype_and_shape(values)
            yield valid, f"{name} must be {kind.__name__} {size}, got {got}"


def _check(rules: Iterable[tuple[bool, str]]) -> None:
    """Raise a ValueError for the first rule that does not hold."""
    for holds, rule in rules:
        if not holds:
            raise ValueError(rule)


def check_camera(name: str) -> None:
    """Raise a ValueError if a camera's name cannot be part of a file name."""
    if not _CAMERA.fullmatch(name):
        raise ValueError(f"camera name {name[:80]!r} must have letters, digits, - _ . and spaces")


def full_name(name: str, names: Iterable[str]) -> str:
    """Return the one of `names` that ends in the dotted `name`, or it in them; else `name`."""
    names = [*names]
    alike = [x for x in names if f".{x}".endswith(f".{name}") or f".{name}".endswith(f".{x}")]
    return alike[0] if len(alike) == 1 and name not in names else name


def choose_cameras(
    available: Mapping[str, T],
    chosen: Sequence[str],
    path: Path,
    others: Mapping[str, str] = MappingProxyType({}),
) -> tuple[dict[str, T], dict[str, str]]:
    """Select cameras of a dataset.

    Args:
        available: camera -> anything.
        chosen: names of the cameras to use, see `full_name`; empty: all.
        path: the dataset.
        others: picture -> why it is not available.

    Returns:
        `available`, in the order of `chosen`; and camera -> why it is left out.

    Raises:
        ValueError: a camera is unknown or chosen twice, or there is none.
    """
    chosen = [full_name(name, available) for name in chosen]
    left = "".join(f"; {name} is left out ({reason})" for name, reason in others.items())
    if not available:
        raise ValueError(f"{path} has no color camera{left}")
    if unknown := [name for name in chosen if name not in available]:
        known = ", ".join(available)
        raise ValueError(f"{path} has no camera {unknown[0]!r}: choose from {known}{left}")
    if len(set(chosen)) < len(chosen):
        raise ValueError(f"each camera of {path} can be chosen only once, got {', '.join(chosen)}")
    skipped = {name: "not chosen" for name in available if chosen and name not in chosen}
    return {name: available[name] for name in chosen or available}, {**others, **skipped}


def joint_names(count: int) -> list[str]:
    """Return the names of joints that nothing else names: joint_1 to joint_J."""
    return [f"joint_{number}" for number in range(1, count + 1)]


def concatenate(parts: Sequence[Episodes]) -> Episodes:
    """Concatenate episodes of one task and robot in host memory, padded to the longest.

    Raises:
        ValueError: `parts` is empty, or its episodes differ in image shapes or a field of `SHARED`.
    """
    same = {name: {getattr(part, name) for part in parts} for name in SHARED}
    same["image shapes"] = {
        tuple(sorted((k, v.shape[2:]) for k, v in part.image.items())) for part in parts
    }
    for name, values in same.items():
        if len(values) != 1:
            raise ValueError(f"all parts must have the same {name}, got {sorted(values)}")
    steps = max(part.state.shape[1] for part in parts)

    def join(*arrays: Array) -> np.ndarray:
        return np.concatenate([_pad(x, steps) for x in arrays])

    attempted = sum(part.attempted for part in parts)
    labels = {name for part in parts for name in part.labels}
    whole = (dataclasses.replace(part, attempted=attempted) for part in parts)
    return jax.tree.map(join, *(labelled(part, labels) for part in whole))


def labelled(episodes: Episodes, labels: Collection[str] = _LABELS) -> Episodes:
    """Return episodes that have these labels, unknown where they had none."""
    unknown: dict[str, Array] = {
        "success": np.full(episodes.num_episodes, -1, np.int32),
        "corrected": np.zeros(episodes.state.shape[:2], bool),
    }
    missing = {name: unknown[name] for name in labels if getattr(episodes, name) is None}
    return dataclasses.replace(episodes, **missing)


def _dtype_and_shape(array: Any) -> str:
    """Describe an array or tracer, or return the `repr` of what a tree map put in its place."""
    return f"{array.dtype}{list(array.shape)}" if hasattr(array, "dtype") else repr(array)


def _pad(array: Array, steps: int) -> Array:
    """Pad `[E, T, ...]` with zeros to T = `steps`; return `[E]` unchanged."""
    if array.ndim == 1 or array.shape[1] == steps:
        return array
    return np.pad(array, [(0, 0), (0, steps - array.shape[1])] + [(0, 0)] * (array.ndim - 2))
