"""Read statistics in the file formats of openpi and LeRobot, and in our own JSON.

statistics.json           ours
assets/**/norm_stats.json openpi's checkpoint, by dataset: {"norm_stats": {"state": {"mean": [...],
                          ...}, "actions": ...}}
norm_stats.json           the same file elsewhere
policy_preprocessor.json  LeRobot policy: its normalizer step names a safetensors file with tensors
                          "observation.state.mean" and so on, as does the unnormalizer step of
                          policy_postprocessor.json
meta/stats.json           LeRobot dataset: {"observation.state": {...}, "action": {...}, ...}
meta/episodes_stats.jsonl LeRobot dataset, version 2.1: one such object per episode, under "stats"
model.safetensors         older LeRobot policy: tensors among the weights, named
                          "normalize_inputs.buffer_observation_state.mean" or, by dataset,
                          "normalize_inputs.so100_buffer_observation_state.mean"
"""

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import safetensors

from lorasp_jax.base import hub, json_values
from lorasp_jax.base.files import (
    as_value_error,
    check_regular,
    join_inside,
    read_json,
    read_json_lines,
    read_text,
)
from lorasp_jax.policies.statistics import NAMES, Statistics, validate

OURS, OPENPI, DATASET = "statistics.json", "norm_stats.json", "stats.json"
EPISODES = "episodes_stats.jsonl"
PIPELINES = ("policy_preprocessor.json", "policy_postprocessor.json")
PIPELINE: dict[str, Any] = {"steps": [{"registry_name?": str, "config?": {}, "state_file?": str}]}
"""Schema of these, see `json_values.check`."""
TENSOR = re.compile(
    r"(?:(?:un)?normalize_\w+\.)?(?:(?:(?P<dataset>.+)[._])?buffer[._])?"
    r"(?P<kind>observation[._]state|action)\.(?P<name>\w+)"
)
"""Pattern of the names of statistics in LeRobot's safetensors files."""
_EPISODE_STATISTICS = ("count", "mean", "std", "min", "max")
_KEYS = ("observation.state", "action"), ("state", "actions")
_KIND = {f"{name}?": [float] for name in NAMES}
_FEATURES, _OPENPI = ({key: _KIND, action: _KIND} for key, action in _KEYS)
_EPISODE = {key: {name: [float] for name in _EPISODE_STATISTICS} for key in _FEATURES}
"""Schemas of statistics in JSON, see `json_values.check`."""
Stats = dict[str, dict[str, np.ndarray]]
"""Statistics by kind ("state", "action") and name."""


def read(where: str | os.PathLike[str], *, dataset: str = "", default: str = "") -> Statistics:
    """Read a robot's statistics, in the order of its joints; `Statistics.to_slots` reorders them.

    Args:
        where: one of the files in the module docstring, or a folder to search for them in that
            order. It can be a local path, a Hub repository or a bucket URL; see `hub.local`.
        dataset: the dataset, if a checkpoint has several. For openpi, its folder under assets/; for
            LeRobot, its name within the tensor names.
        default: the dataset to choose among several if `dataset` is not given.

    Raises:
        ValueError: no statistics, damaged files, several datasets or an unknown one, no state or
            action statistics, or values that were never set.
    """
    path = hub.local(where)
    for pattern, reader in _READERS.items():
        found = [path] if path.is_file() else sorted(path.glob(pattern))
        files = [file for file in found if file.is_file()]
        if files and files[0].match(pattern.rpartition("/")[2]):
            with as_value_error(files[0], safetensors.SafetensorError):
                groups = reader(files)
            if len(groups) > 1:
                dataset = dataset or default
            return validate(_select(groups, dataset, str(where)), str(where))
    raise ValueError(f"no statistics in {where}: it must have one of {', '.join(_READERS)}")


def _select(groups: Mapping[str, Stats], dataset: str, where: str) -> Stats:
    """Return the statistics of a dataset, or of the only one if no name is given."""
    if not dataset and len(groups) == 1:
        return next(iter(groups.values()))
    if dataset not in groups:
        raise ValueError(f"{where} has statistics of {sorted(groups)}, not of {dataset!r}")
    return groups[dataset]


def _ours(files: list[Path]) -> dict[str, Stats]:
    stats = Statistics.from_json(read_text(files[0]))
    return {"": {"state": _arrays(stats.state), "action": _arrays(stats.action)}}


def _openpi(files: list[Path]) -> dict[str, Stats]:
    groups = {}
    for file in files:
        json_values.check(content := read_json(file), {"norm_stats": _OPENPI}, nulls=True)
        stats = content["norm_stats"]
        name = file.parent.as_posix().rpartition("/assets/")[2]
        groups[name] = {"state": _arrays(stats["state"]), "action": _arrays(stats["actions"])}
    return groups


def _dataset(files: list[Path]) -> dict[str, Stats]:
    json_values.check(stats := read_json(files[0]), _FEATURES, nulls=True)
    return {"": {"state": _arrays(stats["observation.state"]), "action": _arrays(stats["action"])}}


def _episodes(files: list[Path]) -> dict[str, Stats]:
    rows = [row["stats"] for row in read_json_lines(files[0])]
    for number, row in enumerate(rows):
        json_values.check(row, _EPISODE, f"the statistics of line {number + 1}")
    kinds = {"state": "observation.state", "action": "action"}
    return {"": {kind: aggregate([row[name] for row in rows]) for kind, name in kinds.items()}}


def aggregate(episodes: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Aggregate the statistics of episodes, without quantiles.

    As LeRobot 0.3.3 does (compute_stats.py, aggregate_feature_stats).
    """
    lengths = {len(stats[name]) for stats in episodes for name in _EPISODE_STATISTICS[1:]}
    if len(lengths) > 1:
        raise ValueError(f"statistics of one feature must have one length, got {sorted(lengths)}")
    values = {
        name: np.array([stats[name] for stats in episodes], float) for name in _EPISODE_STATISTICS
    }
    if values["count"].shape[1:] != (1,) or (values["count"] < 1).any():
        raise ValueError("count must be one number of steps, at least 1")
    mean, std = values["mean"], values["std"]
    with np.errstate(all="ignore"):  # non-finite values are rejected later
        weights = values["count"] / values["count"].sum()
        total_mean = (weights * mean).sum(axis=0)
        total_std = np.sqrt((weights * (std**2 + (mean - total_mean) ** 2)).sum(axis=0))
        low, high = values["min"].min(axis=0), values["max"].max(axis=0)
        return _arrays({"mean": total_mean, "std": total_std, "min": low, "max": high})


def _policy(files: list[Path]) -> dict[str, Stats]:
    tensors: list[tuple[str, np.ndarray]] = []
    for pipeline in (files[0].with_name(name) for name in PIPELINES):
        json_values.check(content := read_json(pipeline), PIPELINE, nulls=True)
        for step in content["steps"]:
            if (
                "normalizer" in (step.get("registry_name") or "")
                and step.get("state_file") is not None
            ):
                tensors += _tensors(join_inside(pipeline.parent, step["state_file"]))
    return _group(tensors)


def _weights(files: list[Path]) -> dict[str, Stats]:
    return _group(pair for file in files for pair in _tensors(file))


_READERS: dict[str, Callable[[list[Path]], dict[str, Stats]]] = {
    OURS: _ours,
    f"assets/**/{OPENPI}": _openpi,
    OPENPI: _openpi,
    PIPELINES[0]: _policy,
    f"meta/{DATASET}": _dataset,
    DATASET: _dataset,
    f"meta/{EPISODES}": _episodes,
    EPISODES: _episodes,
    "*.safetensors": _weights,
}


def _arrays(stats: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the supported statistics that are not None."""
    with np.errstate(over="ignore"):  # overflows to inf, which is rejected later
        return {
            name: np.asarray(stats[name], np.float32)
            for name in NAMES
            if stats.get(name) is not None
        }


def _tensors(file: Path) -> list[tuple[str, np.ndarray]]:
    """Load only the statistics tensors of a file, not its weights."""
    with safetensors.safe_open(check_regular(file), framework="np") as tensors:
        names = [name for name in tensors.keys() if TENSOR.fullmatch(name)]  # noqa: SIM118
        return [(name, tensors.get_tensor(name)) for name in names]


def _group(tensors: Iterable[tuple[str, np.ndarray]]) -> dict[str, Stats]:
    """Group tensors by dataset, kind and name; duplicates must be equal."""
    groups: dict[str, Stats] = {}
    for name, array in tensors:
        match = TENSOR.fullmatch(name)
        if not match or match["name"] not in NAMES:
            continue
        group = groups.setdefault(match["dataset"] or "", {"state": {}, "action": {}})
        stats = group["action" if match["kind"] == "action" else "state"]
        if not np.array_equal(stats.setdefault(match["name"], array), array):
            raise ValueError(f"two different tensors for {name}")
    return groups
