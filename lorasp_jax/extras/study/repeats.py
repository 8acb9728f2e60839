"""Run finished cells again, and compare their runs.

Each round of repeats has a folder like the study's own, in which cells have their names: so the
source of a derived cell and the demonstrations are made again, too, and no result is replaced.
"""

import dataclasses
import itertools
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from lorasp_jax.extras.study import page, progress, statistics
from lorasp_jax.extras.study.progress import CELL_FILE, CellState, Status
from lorasp_jax.extras.study.study import Cell, Derived, Results, Study
from lorasp_jax.training.run_folder import changed_settings, read_json

FOLDER = "repeats"
"""Folder of the rounds, numbered from 1, in the study's folder."""
KEY = "repeats"
"""Key of a cell's further results, each without its config, which is that of the first."""


def load(load_study: Callable[[], Study], folder: Path) -> Study:
    """Load a study to run its finished cells again in another folder.

    The cells keep the settings of their first runs, and so what these took from other results.
    """
    study = load_study()
    statuses = progress.read(study, folder)
    known = {name for name, x in statuses.items() if x.state is CellState.FINISHED and x.config}
    cells = [_fixed(cell, statuses) for cell in study.cells if cell.name in known]
    return dataclasses.replace(study, cells=tuple(cells), finished={})


def with_sources(study: Study, names: Collection[str]) -> list[str]:
    """Return those of the named cells that the study has, each after those that it is made from.

    Raises:
        ValueError: it has none of them.
    """
    wanted = {*names}
    for cell in reversed(study.cells):
        if cell.name in wanted:
            wanted |= {*cell.needs}
    if not (found := [cell.name for cell in study.cells if cell.name in wanted]):
        raise ValueError(
            f"none of {', '.join(names)} can run again: it must be finished, and what it is made "
            "from must be here"
        )
    return found


def next_round(folder: Path, names: Collection[str]) -> Path:
    """Return the folder of the first round that lacks one of the named cells."""
    rounds = (folder / FOLDER / str(number) for number in itertools.count(1))
    return next(x for x in rounds if not all((x / name / CELL_FILE).exists() for name in names))


def collect(found: Results, earlier: Results, folder: Path) -> dict[str, dict[str, Any]]:
    """Add to each result its repeats: those of the earlier one, then others in the folder.

    Raises:
        ValueError: a file is damaged.
    """
    return {name: _with_repeats(name, found[name], earlier.get(name), folder) for name in found}


def compare(results: Results) -> Iterator[str]:
    """Yield lines that compare the repeats of cells with their first runs.

    At the end comes the standard deviation of their success rate between runs.
    """
    runs = []
    for name, first in results.items():
        for number, again in enumerate(first.get(KEY, []), 1):
            yield f"{name}: repeat {number} ({_origin(again)}) minus first run ({_origin(first)})"
            yield f"    {', '.join(_differences(again, first))} points"
        if KEY in first and _is_even(first):
            runs.append(statistics.stacked([x["outcomes"] for x in (first, *first[KEY])]))
    if runs:
        deviation, degrees = statistics.between_runs(runs)
        found = f"{100 * deviation:.1f} points of mean success, {degrees} degrees of freedom"
        yield f"standard deviation between runs of a cell: {found}"


def _fixed(cell: Cell | Derived, statuses: Mapping[str, Status]) -> Cell | Derived:
    """Return a cell that needs only its source, and takes the first results of other cells."""
    if isinstance(cell, Cell):
        config = statuses[cell.name].config
        assert config is not None
        return dataclasses.replace(cell, config=config, after=(), source="")
    if not (transform := cell.transform):
        return dataclasses.replace(cell, after=())
    first = progress.results_of(cell.after, statuses)
    with_first = lambda policy, own, episodes: transform(policy, {**first, **own}, episodes)  # noqa: E731
    return dataclasses.replace(cell, after=(), transform=with_first)


def _with_repeats(
    name: str, result: Mapping[str, Any], earlier: Mapping[str, Any] | None, folder: Path
) -> dict[str, Any]:
    kept = list(earlier.get(KEY, [])) if earlier and _is_alike(earlier, result) else []
    files = (folder / FOLDER).glob(f"*/{name}/{CELL_FILE}")
    for file in sorted(files, key=lambda path: int(path.relative_to(folder).parts[1])):
        again = read_json(file, progress.SCHEMA)
        if _is_alike(again, result):
            del again["config"]
            kept += [again] * (again not in kept)
    return {**result, KEY: kept} if kept else {**result}


def _is_alike(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """Say whether two results have the same tasks and settings, either of an older version."""
    if a["outcomes"].keys() != b["outcomes"].keys():
        return False
    return any(not changed_settings(x["config"], y["config"]) for x, y in ((a, b), (b, a)))


def _differences(again: Mapping[str, Any], first: Mapping[str, Any]) -> Iterator[str]:
    """Yield the paired difference of success by task and, of tasks of one size, of the mean."""
    parts = {task: [task] for task in first["outcomes"]}
    if len(parts) > 1 and _is_even(first):
        parts["mean"] = [*parts]
    for label, tasks in parts.items():
        both = ({task: run["outcomes"][task] for task in tasks} for run in (again, first))
        pair = (statistics.stacked([each]) for each in both)
        yield f"{label} {page.difference(*pair)}"


def _is_even(result: Mapping[str, Any]) -> bool:
    """Say whether all tasks have as many episodes."""
    return len({len(outcomes) for outcomes in result["outcomes"].values()}) == 1


def _origin(result: Mapping[str, Any]) -> str:
    """Return the device and the commit of a result, or its code if there is no commit."""
    known = result.get("provenance")
    if not known:
        return "device and commit not recorded"
    return f"{known['device']}, {known['commit'] or 'code ' + known['code']}"
