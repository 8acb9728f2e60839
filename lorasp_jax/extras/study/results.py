"""All results of a study in one small file, from which tables, figures and page are made."""

import dataclasses
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lorasp_jax.base.digest import verify_digest, with_digest
from lorasp_jax.base.files import as_value_error, read_bytes
from lorasp_jax.base.json_values import check
from lorasp_jax.base.writing import write_text
from lorasp_jax.extras.study.progress import SCHEMA
from lorasp_jax.extras.study.study import Results, Study
from lorasp_jax.training.experiment_file import call

RESULTS_FILE = "results.json"


def write(path: Path, study: str, results: Results) -> None:
    """Write the content of cell.json of all finished cells, by cell name, atomically.

    The same results give the same bytes. Settings that most cells share are stored once.
    """
    settings = {name: dict(_flat(result["config"])) for name, result in results.items()}
    common = _most_common(list(settings.values()))
    cells = {
        name: {**result, "config": _changes(settings[name], common)}
        for name, result in sorted(results.items())
    }
    lines = [f"{json.dumps(name)}:{_dump(cell)}" for name, cell in cells.items()]
    digest = with_digest({"study": study, "common": common, "cells": cells})["digest"]
    rest = {"common": common, "digest": digest, "study": study}
    write_text(path, '{"cells":{\n' + ",\n".join(lines) + f"\n}},\n{_dump(rest)[1:]}\n")


def load_study(config: Path, scale: str, path: Path | None = None) -> Study:
    """Load the study that a file defines; it starts from the results in `path`, if given.

    Raises:
        ValueError: the file is missing, its code fails, or `get_study` does not return a `Study`;
            see also `load`.
    """
    study = call(config, "get_study", scale)
    if not isinstance(study, Study):
        raise ValueError(f"get_study in {config} must return a Study, got {type(study).__name__}")
    return dataclasses.replace(study, finished=load(path, study.name)) if path else study


def load(path: Path, study: str = "") -> dict[str, dict[str, Any]]:
    """Read the results of all cells, by cell name, from a file of `write`.

    Raises:
        ValueError: the file does not exist, is damaged or, if `study` is given, has the results of
            another study.
    """
    with as_value_error(path, remedy=": restore it, or run the study again"):
        content = verify_digest(json.loads(read_bytes(path)))
        check(content, {"study": str, "common": {}, "cells": {str: {"config": {}}}})
        if study and content["study"] != study:
            raise ValueError(f"it has the results of {content['study']}, not of {study}")
        results = {
            name: {**cell, "config": _nested({**content["common"], **cell["config"]})}
            for name, cell in content["cells"].items()
        }
        check(results, {str: SCHEMA})
        return results


def ran(results: Results, *policies: Sequence[str]) -> list[list[Mapping[str, Any]]]:
    """Return the results of policies, given their names by seed, for seeds that all have run."""
    whole = [names for names in zip(*policies, strict=True) if all(n in results for n in names)]
    return [[results[names[i]] for names in whole] for i in range(len(policies))]


def rate_of(pilot: str) -> float:
    """Return the learning rate of a pilot, the last part of its name."""
    return float(pilot.rpartition("/")[2])


def best_pilot(results: Results, pilots: Sequence[str]) -> str:
    """Return the pilot with the most success, of equals the first; all have as many episodes."""
    return max(pilots, key=lambda name: "".join(results[name]["outcomes"].values()).count("1"))


def best_rate(results: Results, pilots: Sequence[str]) -> float:
    """Return the learning rate of the best pilot."""
    return rate_of(best_pilot(results, pilots))


def _dump(value: Any) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def _flat(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted names and values of nested settings."""
    for name, value in settings.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Undo `_flat`."""
    nested: dict[str, Any] = {}
    for name, value in flat.items():
        *parents, last = name.split(".")
        inner = nested
        for parent in parents:
            inner = inner.setdefault(parent, {})
        inner[last] = value
    return nested


def _most_common(settings: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the most frequent value of every setting that all cells have."""
    shared = set.intersection(*map(set, settings)) if settings else set()
    common = {}
    for name in sorted(shared):
        counts = Counter(_dump(cell[name]) for cell in settings)
        common[name] = json.loads(min(counts, key=lambda value: (-counts[value], value)))
    return common


def _changes(settings: Mapping[str, Any], common: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that are not in `common`."""
    missing = object()
    return {name: value for name, value in settings.items() if common.get(name, missing) != value}
