"""Which cells of a study are finished, can run, wait, or cannot go on, from their folders alone."""

import contextlib
import dataclasses
import enum
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from lorasp_jax.base.errors import describe
from lorasp_jax.base.writing import TEMPORARY_SUFFIX, write_text
from lorasp_jax.config import Config
from lorasp_jax.extras.study.study import Cell, Derived, Results, Study
from lorasp_jax.training import records
from lorasp_jax.training.run_folder import CONFIG_FILE, changed_settings, read_json, to_json

CELL_FILE, FAILED_FILE = "cell.json", "failed.txt"
SCHEMA: records.Schema = {
    "config": records.CONFIG,
    "outcomes": {str: str},
    "before?": {str: str},
    "active_rank": {str: float},
    "layer_active_rank": {str: {str: [float]}},
    "active_rank_histogram": {str: [int]},
    "trainable_parameters": int,
    "total_parameters": int,
    "seconds": records.TIMES,
    "speed": {str: float},
    "measures": {},
}
"""Schema of cell.json."""


class State(enum.StrEnum):
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


BROKEN = frozenset({State.FAILED, State.DAMAGED, State.CHANGED})
"""States that need attention."""


@dataclass(frozen=True)
class Status:
    """State of a cell.

    Attributes:
        reason: why the cell does not run or is not finished, on one line.
        config: the config of the cell's run, or of its source's; None if it depends on results that
            do not exist yet.
        guess: what `config` will be, except for numbers that depend on those results; None if
            `config` is known, or if it cannot be made from invented results.
        result: content of cell.json if the cell is finished, or what the study starts from.
    """

    state: State
    reason: str = ""
    config: Config | None = None
    result: dict[str, Any] | None = None
    guess: Config | None = None


Versions: TypeAlias = tuple[tuple[int, int, int] | None, ...]
"""Inode, time and size of each of a cell's files that exists."""
Inputs: TypeAlias = tuple[Versions, list[Status]]
"""What the state of a cell depends on: its files and the states of the cells that it needs."""


class Board:
    """The states of all cells of a study, read from the study's folder."""

    def __init__(self, study: Study, folder: Path) -> None:
        """Read nothing yet."""
        self._study, self._folder = study, folder
        self._known: dict[str, tuple[Inputs, Status]] = {}

    def read(self) -> dict[str, Status]:
        """Return the current state of every cell, in the study's order.

        A cell has the same state as before, the same object, if neither its files nor the states of
        those that it needs have changed.
        """
        statuses: dict[str, Status] = {}
        for cell in self._study.cells:
            inputs = _versions(self._folder / cell.name), [statuses[name] for name in cell.needs]
            known, status = self._known.get(cell.name, (None, None))
            if status is None or status.state is State.DAMAGED or not _same(inputs, known):
                status = self._status(cell, statuses)
                self._known[cell.name] = inputs, status
            statuses[cell.name] = status
        return statuses

    def _status(self, cell: Cell | Derived, others: dict[str, Status]) -> Status:
        """Return the state of a cell, given the states of those that it needs."""
        try:
            return self._intact_status(cell, others)
        except ValueError as error:
            return Status(State.DAMAGED, str(describe(error)))

    def _intact_status(self, cell: Cell | Derived, others: dict[str, Status]) -> Status:
        """Return the state of a cell, given the states of those that it needs.

        Raises:
            ValueError: a file is damaged.
        """
        folder = self._folder / cell.name
        own = read_json(folder / CELL_FILE, SCHEMA)
        result = own or {**self._study.finished.get(cell.name, {})}
        # A finished cell whose own settings are unknown counts as unfinished, too.
        unfinished = [
            name
            for name in cell.needs
            if others[name].state is not State.FINISHED or others[name].config is None
        ]
        if unfinished:
            guess = _guess(cell, others)
            if result:
                return Status(State.FINISHED, result=result, guess=guess)
            waits = ", ".join(f"{name} ({others[name].state})" for name in unfinished)
            return Status(State.WAITING, f"for {waits}", guess=guess)
        try:
            config = _config(cell, others, results_of(cell.needs, others))
        except Exception as error:  # the study's function may raise anything
            return Status(State.FAILED, f"its config cannot be made: {one_line(error)}")
        recorded = result["config"] if result else read_json(folder / CONFIG_FILE, records.CONFIG)
        if recorded and (changed := changed_settings(recorded, describe_config(cell, config))):
            return Status(State.CHANGED, f"it was run with other {', '.join(changed)}", config)
        if not own and (failure := _failure(folder)):
            return Status(State.FAILED, failure, config, result or None)
        if result:
            return Status(State.FINISHED, "", config, result)
        return Status(State.RUNNABLE, "", config)


def _config(cell: Cell | Derived, others: Mapping[str, Status], results: Results) -> Config:
    """Return the config of a cell's run, or of its source's; it may be guessed for the latter."""
    if isinstance(cell, Derived):
        source = others[cell.source]
        config = source.config or source.guess
        assert config is not None
        return config
    config = cell.config if isinstance(cell.config, Config) else cell.config(results)
    return dataclasses.replace(config, name=Path(cell.name).name)


def _guess(cell: Cell | Derived, others: Mapping[str, Status]) -> Config | None:
    """Make a config from invented results of the cells that are not finished."""
    with contextlib.suppress(Exception):  # the study's function may raise anything
        results = {name: others[name].result or _invented(others[name]) for name in cell.needs}
        return _config(cell, others, results)


def _invented(status: Status) -> dict[str, Any]:
    """Return results that an unfinished cell might have: no success, and active ranks of 1."""
    config = status.config or status.guess
    assert config is not None
    towers: dict[str, Any] = {"vision": {}, "language": {}, "action": {}}
    return {
        "config": to_json(config),
        "outcomes": dict.fromkeys(config.tasks, "0" * config.evaluation.episodes),
        "active_rank": {**dict.fromkeys(towers, 1.0), "mean": 1.0},
        "layer_active_rank": towers,
        "active_rank_histogram": {},
        "trainable_parameters": 1,
        "total_parameters": 1,
        "seconds": {"total": 1.0},
        "speed": {},
        "measures": {},
    }


def describe_config(cell: Cell | Derived, config: Config) -> dict[str, Any]:
    """Return the settings recorded in cell.json; those of a derived cell name its source."""
    source = {"source": cell.source} if isinstance(cell, Derived) else {}
    return {**to_json(config), **source}


def results_of(names: Iterable[str], statuses: Mapping[str, Status]) -> dict[str, dict[str, Any]]:
    """Return the results of those of the named cells that are finished."""
    results = {name: statuses[name].result for name in names}
    return {name: result for name, result in results.items() if result is not None}


def record_failure(folder: Path, reason: str, details: str) -> None:
    """Write failed.txt: the reason on one line, then the details."""
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / FAILED_FILE, f"{reason}\n\n{details}")


def clear_failure(folder: Path) -> None:
    """Remove failed.txt, so that the cell can run again."""
    for path in (folder / FAILED_FILE, *folder.glob(f".{FAILED_FILE}.*{TEMPORARY_SUFFIX}")):
        path.unlink(missing_ok=True)


def tidy(folder: Path) -> None:
    """Delete what a finished cell no longer needs: checkpoints and TensorBoard's events."""
    for name in ("checkpoints", "tensorboard"):
        shutil.rmtree(folder / name, ignore_errors=True)


def one_line(error: BaseException) -> str:
    """Describe any error on one line."""
    known = describe(error) if isinstance(error, Exception) else None
    return known or f"{type(error).__name__}: {' '.join(str(error).split())[:500]}"


def _failure(folder: Path) -> str:
    """Return the reason in failed.txt, "" if there is none."""
    try:
        return (folder / FAILED_FILE).read_text().partition("\n")[0]
    except OSError:
        return ""


def _versions(folder: Path) -> Versions:
    """Return what changes whenever one of a cell's files does."""
    found = []
    for name in (CELL_FILE, CONFIG_FILE, FAILED_FILE):
        try:
            stat = (folder / name).stat()
        except OSError:
            found.append(None)
        else:
            found.append((stat.st_ino, stat.st_mtime_ns, stat.st_size))
    return tuple(found)


def _same(a: Inputs, b: Inputs | None) -> bool:
    """Return whether inputs are the same: equal versions, and identical objects for states."""
    return b is not None and a[0] == b[0] and [*map(id, a[1])] == [*map(id, b[1])]
