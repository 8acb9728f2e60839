"""Which cells of a study are finished, can run, wait, or cannot go on, from their folders alone."""

import dataclasses
import enum
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from envs.cli.errors import describe
from envs.datasets.writing import TEMPORARY_SUFFIX, write_text
from lorasp_jax.config import Config
from lorasp_jax.study.study import Cell, Derived, Study
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
        result: content of cell.json if the cell is finished, or what the study starts from.
    """

    state: State
    reason: str = ""
    config: Config | None = None
    result: dict[str, Any] | None = None


class Board:
    """The states of all cells of a study, read from the study's folder."""

    def __init__(self, study: Study, folder: Path) -> None:
        """Read nothing yet."""
        self._study, self._folder = study, folder
        self._known: dict[Path, tuple[tuple[int, int], dict[str, Any]]] = {}

    def read(self) -> dict[str, Status]:
        """Return the current state of every cell, in the study's order."""
        statuses: dict[str, Status] = {}
        for cell in self._study.cells:
            try:
                statuses[cell.name] = self._status(cell, statuses)
            except ValueError as error:
                statuses[cell.name] = Status(State.DAMAGED, str(describe(error)))
        return statuses

    def _status(self, cell: Cell | Derived, others: dict[str, Status]) -> Status:
        """Return the state of a cell, given the states of those that it needs.

        Raises:
            ValueError: a file is damaged.
        """
        folder = self._folder / cell.name
        own = self._read(folder / CELL_FILE, SCHEMA)
        result = own or {**self._study.finished.get(cell.name, {})}
        # A finished cell whose own settings are unknown counts as unfinished, too.
        unfinished = [
            name
            for name in cell.needs
            if others[name].state is not State.FINISHED or others[name].config is None
        ]
        if unfinished:
            if result:
                return Status(State.FINISHED, result=result)
            waits = ", ".join(f"{name} ({others[name].state})" for name in unfinished)
            return Status(State.WAITING, f"for {waits}")
        try:
            config = self._config(cell, others)
        except Exception as error:  # the study's function may raise anything
            return Status(State.FAILED, f"its config cannot be made: {one_line(error)}")
        recorded = result["config"] if result else self._read(folder / CONFIG_FILE, records.CONFIG)
        if recorded and (changed := changed_settings(recorded, describe_config(cell, config))):
            return Status(State.CHANGED, f"it was run with other {', '.join(changed)}", config)
        if not own and (failure := _failure(folder)):
            return Status(State.FAILED, failure, config, result or None)
        if result:
            return Status(State.FINISHED, "", config, result)
        return Status(State.RUNNABLE, "", config)

    def _config(self, cell: Cell | Derived, others: dict[str, Status]) -> Config:
        """Return the config of a cell's run, or of its source's."""
        if isinstance(cell, Derived):
            config = others[cell.source].config
            assert config is not None  # the source is finished, and so is all that it needs
            return config
        config = cell.config
        if not isinstance(config, Config):
            config = config(results_of(cell.needs, others))
        return dataclasses.replace(config, name=Path(cell.name).name)

    def _read(self, path: Path, schema: records.Schema) -> dict[str, Any]:
        """Read a JSON file unless it was read before and has not changed; {} if there is none."""
        try:
            stat = path.stat()
        except OSError:
            return {}
        version = stat.st_mtime_ns, stat.st_size
        if path not in self._known or self._known[path][0] != version:
            self._known[path] = version, read_json(path, schema)
        return self._known[path][1]


def describe_config(cell: Cell | Derived, config: Config) -> dict[str, Any]:
    """Return the settings recorded in cell.json; those of a derived cell name its source."""
    source = {"source": cell.source} if isinstance(cell, Derived) else {}
    return {**to_json(config), **source}


def results_of(names: Iterable[str], statuses: dict[str, Status]) -> dict[str, dict[str, Any]]:
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
