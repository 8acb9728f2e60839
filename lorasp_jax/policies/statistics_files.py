"""Statistics as openpi and LeRobot keep them, and our own JSON.

statistics.json           ours
norm_stats.json           openpi: {"norm_stats": {"state": {"mean": [...], ...}, "actions": ...}},
                          in a checkpoint below assets/<name of the data>/
meta/stats.json           a LeRobot dataset: {"observation.state": {...}, "action": {...}, ...}
meta/episodes_stats.jsonl one of version 2.1: such an object for each episode, below "stats"
policy_preprocessor.json  a LeRobot policy: its steps, of which the normaliser's and, from
                          policy_postprocessor.json, the unnormaliser's name a safetensors file
                          with tensors "observation.state.mean" and so on
model.safetensors         an older LeRobot policy: among its weights are tensors
                          "normalize_inputs.buffer_observation_state.mean", perhaps by dataset,
                          "normalize_inputs.so100_buffer_observation_state.mean"
"""

import json
import os
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors

from envs.datasets.files import beside, read_text
from lorasp_jax.policies.statistics import NAMES, Statistics, checked
from lorasp_jax.storage import hub

OURS, OPENPI, DATASET = "statistics.json", "norm_stats.json", "stats.json"
EPISODES = "episodes_stats.jsonl"
PIPELINES = ("policy_preprocessor.json", "policy_postprocessor.json")
TENSOR = re.compile(
    r"(?:(?:un)?normalize_\w+\.)?(?:(?:(?P<dataset>.+)[._])?buffer[._])?"
    r"(?P<kind>observation[._]state|action)\.(?P<name>\w+)"
)
"""A statistic's name in LeRobot's safetensors."""
_OF_EPISODES = ("count", "mean", "std", "min", "max")
_UNREADABLE = (
    OSError, AttributeError, KeyError, TypeError, ValueError, OverflowError, RecursionError,
    safetensors.SafetensorError,
)  # fmt: skip
Known = dict[str, dict[str, np.ndarray]]  # by kind, state or action, and name


def read(where: str | os.PathLike[str], *, dataset: str = "") -> Statistics:
    """Statistics of a robot, in the order of its numbers; `Statistics.placed` puts them in slots.

    Args:
        where: a file or folder as above, the first that is there; or a place that
            `hub.local` fetches.
        dataset: which data, where a checkpoint knows several: a name below openpi's assets/, or the
            one in LeRobot's tensors.

    Raises:
        ValueError: nothing of the kind, damaged, several datasets or not the one asked for, no
            statistics of states or actions, or such that were never set.
    """
    path = hub.local(where)
    for pattern, reader in _READERS.items():
        found = [path] if path.is_file() else _files(path, pattern)
        if found and found[0].match(pattern.rpartition("/")[2]):
            try:
                groups = reader(found)
            except _UNREADABLE as error:
                why = f"{type(error).__name__}: {str(error)[:200]}"
                raise ValueError(f"the statistics of {where} cannot be read ({why}).") from error
            return checked(_chosen(groups, dataset, str(where)), str(where))
    raise ValueError(f"{where} holds no statistics: none of {', '.join(_READERS)}.")


def _chosen(groups: Mapping[str, Known], dataset: str, where: str) -> Known:
    """Those of one dataset; without a name, of the only one."""
    if not dataset and len(groups) == 1:
        return next(iter(groups.values()))
    if not groups:
        raise ValueError(f"{where} has no tensors of statistics.")
    if dataset not in groups:
        names = ", ".join(map(repr, sorted(groups)))
        raise ValueError(f"{where} has statistics of {names}, not of {dataset!r}: choose one.")
    return groups[dataset]


def _ours(files: list[Path]) -> dict[str, Known]:
    found = Statistics.from_json(read_text(files[0]))
    return {"": {"state": _arrays(found.state), "action": _arrays(found.action)}}


def _openpi(files: list[Path]) -> dict[str, Known]:
    groups = {}
    for file in files:
        known = json.loads(read_text(file))["norm_stats"]
        name = file.parent.as_posix().rpartition("/assets/")[2]
        groups[name] = {"state": _arrays(known["state"]), "action": _arrays(known["actions"])}
    return groups


def _dataset(files: list[Path]) -> dict[str, Known]:
    known = json.loads(read_text(files[0]))
    return {"": {"state": _arrays(known["observation.state"]), "action": _arrays(known["action"])}}


def _episodes(files: list[Path]) -> dict[str, Known]:
    lines = read_text(files[0]).splitlines()
    rows = [json.loads(line)["stats"] for line in lines if line.strip()]
    kinds = {"state": "observation.state", "action": "action"}
    return {"": {kind: _joined([row[name] for row in rows]) for kind, name in kinds.items()}}


def _joined(episodes: list[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """As LeRobot joins them (compute_stats.py, aggregate_feature_stats, at 0.3.3): no quantiles."""
    values = {name: np.array([known[name] for known in episodes], float) for name in _OF_EPISODES}
    mean, std = values["mean"], values["std"]
    with np.errstate(all="ignore"):  # what is not finite is refused later
        share = values["count"] / values["count"].sum()
        whole = (share * mean).sum(axis=0)
        spread = np.sqrt((share * (std**2 + (mean - whole) ** 2)).sum(axis=0))
        low, high = values["min"].min(axis=0), values["max"].max(axis=0)
        return _arrays({"mean": whole, "std": spread, "min": low, "max": high})


def _policy(files: list[Path]) -> dict[str, Known]:
    tensors: list[tuple[str, np.ndarray]] = []
    for pipeline in (files[0].with_name(name) for name in PIPELINES):
        for step in json.loads(read_text(pipeline))["steps"]:
            if "normalizer" in step.get("registry_name", "") and "state_file" in step:
                tensors += _tensors(beside(pipeline, step["state_file"]))
    return _grouped(tensors)


def _weights(files: list[Path]) -> dict[str, Known]:
    return _grouped(pair for file in files for pair in _tensors(file))


_READERS: dict[str, Callable[[list[Path]], dict[str, Known]]] = {
    OURS: _ours,
    OPENPI: _openpi,
    f"assets/**/{OPENPI}": _openpi,
    f"meta/{DATASET}": _dataset,
    DATASET: _dataset,
    f"meta/{EPISODES}": _episodes,
    EPISODES: _episodes,
    PIPELINES[0]: _policy,
    "*.safetensors": _weights,
}


def _files(folder: Path, pattern: str) -> list[Path]:
    """Files, not what only has such a name."""
    return [path for path in sorted(folder.glob(pattern)) if path.is_file()]


def _arrays(known: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """What has a name of ours and a value."""
    with np.errstate(over="ignore"):  # what is infinite then is refused
        return {
            name: np.asarray(known[name], np.float32)
            for name in NAMES
            if known.get(name) is not None
        }


def _tensors(file: Path) -> list[tuple[str, np.ndarray]]:
    """Those of statistics; a model's weights beside them are not read."""
    with safetensors.safe_open(file, framework="np") as opened:
        names = [name for name in opened.keys() if TENSOR.fullmatch(name)]  # noqa: SIM118
        return [(name, opened.get_tensor(name)) for name in names]


def _grouped(tensors: Iterable[tuple[str, np.ndarray]]) -> dict[str, Known]:
    """By dataset, kind and name; what is there twice must agree."""
    groups: dict[str, Known] = {}
    for name, array in tensors:
        found = TENSOR.fullmatch(name)
        if not found or found["name"] not in NAMES:
            continue
        group = groups.setdefault(found["dataset"] or "", {"state": {}, "action": {}})
        known = group["action" if found["kind"] == "action" else "state"]
        if not np.array_equal(known.setdefault(found["name"], array), array):
            raise ValueError(f"it has two different tensors for {name}.")
    return groups
