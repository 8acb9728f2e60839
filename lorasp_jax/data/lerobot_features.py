"""What a LeRobot dataset says about its features: which are color cameras, what dimensions mean.

Sources: LeRobot, src/lerobot/datasets/video_utils.py at 0.3.3 and depth_utils.py at 0.6.1 (marks of
depth); openpi, examples/libero (one name for a whole vector).
"""

import collections
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lorasp_jax.base.files import RefusedError, as_int

Features = Mapping[str, Mapping[str, Any]]
_MAX_DIM = 10_000  # limit for state and action
_PREFIXES = ("observation.", "images.")
SUCCESS, DONE, INTERVENTION = "next.success", "next.done", "intervention"
"""Marks of frames: the task is done; the episode has ended and was not cut off; a person acts.
(LeRobot 0.6.1, scripts/lerobot_eval.py and rollout/strategies/dagger.py)"""


def pictures(features: Features) -> tuple[dict[str, str], dict[str, str]]:
    """Find the features that are pictures.

    Returns:
        Camera -> feature, named without the usual prefixes if these names are unique; and feature
        -> why it is not a color camera, for those that are not.
    """
    keys = [key for key, feature in features.items() if feature["dtype"] in ("video", "image")]
    names = list(keys)
    for prefix in _PREFIXES:
        names = [name.removeprefix(prefix) for name in names]
    unique = len(set(names)) == len(names)
    reasons = {key: reason for key in keys if (reason := _why_not_color(features[key]))}
    return dict(zip(names if unique else keys, keys, strict=True)), reasons


def marks(features: Features) -> list[str]:
    """Return the features that mark success, the end of an episode and a person's corrections.

    These are one number or truth value per frame; others of such names mean something else.
    """
    ends = (INTERVENTION, f"is_{INTERVENTION}")  # the second in HIL-SERL's recordings
    known = (SUCCESS, DONE)
    return [
        name
        for name, feature in features.items()
        if (name in known or name.rpartition(".")[2] in ends)
        and feature["dtype"].startswith(("bool", "int", "uint", "float"))
        and feature.get("shape") in (None, [], [1])
    ]


def _why_not_color(feature: Mapping[str, Any]) -> str:
    """Return why a picture feature is no color camera, or an empty string."""
    marks = {**(feature.get("video_info") or {}), **(feature.get("info") or {})}
    marks = {name.removeprefix("video."): value for name, value in marks.items()}
    shape = list(feature.get("shape") or ())
    gray = str(marks.get("pix_fmt")).startswith("gray") or marks.get("channels") == 1
    if marks.get("is_depth_map"):
        return "depth"
    return "one channel" if gray or 1 in shape or len(shape) == 2 else ""


def dimension_names(features: Features, key: str, path: Path) -> list[str]:
    """Return the names of a feature's dimensions, or their indices if they are unnamed.

    Errors name `path`, that of meta/info.json.

    Raises:
        KeyError, TypeError, ValueError: the feature is missing, or is no vector.
    """
    shape = [as_int(size) for size in features[key].get("shape") or [0]]
    dim = math.prod(shape)
    if not 0 < dim <= _MAX_DIM or dim != max(shape, default=1):
        found = features[key].get("shape")
        raise RefusedError(f"{path}: {key} must be one vector per frame, but has shape {found}")
    names = _flat(features[key].get("names"))
    return names if len(names) == dim else [str(i) for i in range(dim)]


def _flat(names: Any) -> list[str]:
    """Flatten names, which may be listed, grouped ({"motors": [...]}) or numbered ({"x": 0}).

    If groups repeat names, as those of two arms do, each name gets its group's as a prefix.
    """
    if isinstance(names, str | int) and not isinstance(names, bool):
        return [str(names)]
    if isinstance(names, list):
        parts = [_flat(part) for part in names]
        return [name for part in parts for name in part] if all(parts) else []
    if not isinstance(names, Mapping):
        return []
    if sorted(map(str, names.values())) == sorted(map(str, range(len(names)))):
        return sorted(names, key=lambda name: int(names[name]))
    groups = {group: _flat(part) for group, part in names.items()}
    flat = [name for part in groups.values() for name in part]
    if len(set(flat)) == len(flat) or len(groups) == 1:
        return flat
    return [f"{group}.{name}" for group, part in groups.items() for name in part]


def grippers(names: Sequence[str]) -> list[int]:
    """Return the dimensions named after a gripper, as in LeRobot 0.6, or else the last one.

    (processor/relative_action_processor.py)
    """
    return [i for i, name in enumerate(names) if "gripper" in name.lower()] or [len(names) - 1]


def select(names: Sequence[str], wanted: Sequence[str], what: str) -> list[int]:
    """Return the indices of dimensions given by name or index; all if `wanted` is empty.

    Raises:
        ValueError: there is no such dimension, or there are several.
    """
    if not wanted:
        return list(range(len(names)))
    places: dict[str, set[int]] = collections.defaultdict(set)
    for index, name in enumerate(names):
        places[str(index)].add(index)
        places[name].add(index)
    for text in wanted:
        if text not in places:
            known = list(dict.fromkeys([*map(str, range(len(names))), *names]))
            raise ValueError(f"{what} has no {text}: choose from {known}")
        if len(places[text]) > 1:
            several = ", ".join(map(str, sorted(places[text])))
            raise ValueError(f"{what} has several {text}, dimensions {several}: choose by index")
    return [next(iter(places[text])) for text in wanted]


def rows(column: pa.ChunkedArray, dim: int) -> np.ndarray:
    """Convert a column of numbers, or of (nested) lists of `dim` numbers, to f64 `[T, dim]`.

    LeRobot stores features of shape `[1]` as plain numbers.

    Raises:
        ValueError: a row has another number of values.
    """
    values: Any = column.combine_chunks()
    if not len(values):
        return np.empty((0, dim))
    found = 1
    while not pa.types.is_struct(values.type) and pa.types.is_nested(values.type):
        sizes = pc.unique(pc.list_value_length(values)).to_pylist()
        if len(sizes) > 1 or sizes[0] is None:
            raise ValueError(f"its rows have {sizes} values, not {dim}")
        found *= sizes[0]
        values = values.flatten()
    if found != dim:
        raise ValueError(f"its rows have {found} values, not {dim}, of the type {values.type}")
    try:
        numbers = values.cast(pa.float64())
    except pa.ArrowException as error:
        raise ValueError(f"its values are {values.type}, not numbers") from error
    return numbers.to_numpy(zero_copy_only=False).reshape(-1, dim)
