"""Which cells of a study are finished, can run, wait, or cannot go on, from their folders alone."""

import dataclasses
import enum
import functools
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lorasp_jax.base.errors import describe_any
from lorasp_jax.base.writing import TEMPORARY_SUFFIX, write_text
from lorasp_jax.config import Config
from lorasp_jax.extras.study.study import Cell, Derived, Study
from lorasp_jax.training import records
from lorasp_jax.training.finished_run import recorded_config
from lorasp_jax.training.run_folder import CONFIG_FILE, changed_settings, read_json, to_json

CELL_FILE, FAILED_FILE = "cell.json", "failed.txt"
EVALUATED_FILE = "evaluated.json"
"""What cell.json begins with, written before the policy is measured."""
_RUN: records.Schema = {
    "provenance?": {str: str},
    "outcomes": {str: str},
    "before?": {str: str},
    "active_rank?": {str: float},
    "layer_active_rank?": {str: {str: [float]}},
    "active_rank_histogram?": {str: [int]},
    "trainable_parameters?": int,
    "total_parameters?": int,
    "seconds?": records.TIMES,
}
SCHEMA: records.Schema = {"config": records.CONFIG, **_RUN, "repeats?": [_RUN]}
"""Schema of cell.json, and of results with repeats; what `measure` adds is not checked."""


class CellState(enum.StrEnum):
    """State of a cell.

    A damaged cell has an unreadable file, and a changed one was run with other settings than the
    study's: nothing is done with these until someone removes the folder.
    """

    FINISHED = enum.auto()
    RUNNABLE = enum.auto()
    WAITING = enum.auto()
    FAILED = enum.auto()
    DAMAGED = enum.auto()
    CHANGED = enum.auto()


BROKEN = frozenset({CellState.FAILED, CellState.DAMAGED, CellState.CHANGED})
"""States that need attention."""


@dataclass(frozen=True)
class Status:
    """State of a cell.

    Attributes:
        reason: why the cell does not run or is not finished, on one line.
        config: the config of the cell's run; None if it depends on results that do not exist yet.
        result: content of cell.json if the cell is finished, or what the study starts from.
    """

    state: CellState
    reason: str = ""
    config: Config | None = None
    result: dict[str, Any] | None = None


def read(study: Study, folder: Path) -> dict[str, Status]:
    """Return the current state of every cell, in the study's order, from the study's folder."""
    statuses: dict[str, Status] = {}
    run_config = functools.cache(recorded_config)
    for cell in study.cells:
        known = {**study.finished.get(cell.name, {})}
        try:
            statuses[cell.name] = _status(cell, folder / cell.name, known, statuses, run_config)
        except ValueError as error:
            statuses[cell.name] = Status(CellState.DAMAGED, describe_any(error))
    return statuses


def _status(
    cell: Cell | Derived,
    folder: Path,
    known: dict[str, Any],
    others: Mapping[str, Status],
    run_config: Callable[[Path], Config],
) -> Status:
    """Return the state of a cell, given its known result and the states of the cells before it.

    Raises:
        ValueError: a file is damaged.
    """
    own = read_json(folder / CELL_FILE, SCHEMA)
    result = own or known
    # A finished cell whose own settings are unknown counts as unfinished, too.
    unfinished = [
        name
        for name in cell.needs
        if others[name].state is not CellState.FINISHED or others[name].config is None
    ]
    if unfinished:
        if result:
            return Status(CellState.FINISHED, result=result)
        waits = ", ".join(f"{name} ({others[name].state})" for name in unfinished)
        return Status(CellState.WAITING, f"for {waits}")
    if result and _is_elsewhere(cell):
        return Status(CellState.FINISHED, result=result)
    try:
        config = _config(cell, others, run_config)
    except Exception as error:  # the study's function may raise anything
        return Status(CellState.FAILED, f"its config cannot be made: {describe_any(error)}")
    if result:
        changed = changed_settings(result["config"], describe_config(cell, config))
    else:
        begun = read_json(folder / CONFIG_FILE, records.CONFIG)
        changed = changed_settings(begun, to_json(config)) if begun else []
    if changed:
        return Status(CellState.CHANGED, f"it was run with other {', '.join(changed)}", config)
    if not own and (failure := _failure(folder)):
        return Status(CellState.FAILED, failure, config, result or None)
    state = CellState.FINISHED if result else CellState.RUNNABLE
    return Status(state, "", config, result or None)


def _is_elsewhere(cell: Cell | Derived) -> bool:
    """Say whether a cell is made from a run that is not on this machine."""
    source = cell.source if isinstance(cell, Derived) else ""
    return isinstance(source, Path) and not source.exists()


def _config(
    cell: Cell | Derived, others: Mapping[str, Status], run_config: Callable[[Path], Config]
) -> Config:
    """Return the config of a cell's run; raise ValueError if its source is not finished."""
    if isinstance(cell, Derived):
        source = cell.source
        found = run_config(source) if isinstance(source, Path) else others[source].config
        assert found is not None
        return cell.config(found)
    config = cell.config
    if not isinstance(config, Config):
        config = config(results_of(cell.needs, others))
    return dataclasses.replace(config, name=Path(cell.name).name)


def describe_config(cell: Cell | Derived, config: Config) -> dict[str, Any]:
    """Return the settings recorded in cell.json; those of a derived cell name its source."""
    if not isinstance(cell, Derived):
        return to_json(config)
    return {**to_json(config), "source": str(cell.source), **cell.settings}


def results_of(names: Iterable[str], statuses: Mapping[str, Status]) -> dict[str, dict[str, Any]]:
    """Return the results of those of the named cells that are finished."""
    results = {name: statuses[name].result for name in names}
    return {name: result for name, result in results.items() if result is not None}


def record_failure(folder: Path, reason: str, details: str) -> None:
    """Write failed.txt: the reason on one line, then the details."""
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / FAILED_FILE, f"{reason}\n\n{details}")


def has_ended(folder: Path) -> bool:
    """Say whether a cell is finished or has failed."""
    return (folder / CELL_FILE).exists() or (folder / FAILED_FILE).exists()


def clear_failure(folder: Path) -> None:
    """Remove failed.txt, so that the cell can run again."""
    for path in (folder / FAILED_FILE, *folder.glob(f".{FAILED_FILE}.*{TEMPORARY_SUFFIX}")):
        path.unlink(missing_ok=True)


def tidy(folder: Path) -> None:
    """Delete what a finished cell no longer needs, such as checkpoints."""
    (folder / EVALUATED_FILE).unlink(missing_ok=True)
    for name in ("checkpoints", "tensorboard"):
        shutil.rmtree(folder / name, ignore_errors=True)


def _failure(folder: Path) -> str:
    """Return the reason in failed.txt, "" if there is none."""
    path = folder / FAILED_FILE
    return path.read_text("utf-8").partition("\n")[0] if path.exists() else ""
