"""How long cells take, as told by those that are finished."""

import statistics
from collections.abc import Mapping
from typing import Any

from lorasp_jax.config import Config
from lorasp_jax.study.status import State, Status
from lorasp_jax.study.study import Cell, Derived, Study


def seconds(study: Study, statuses: Mapping[str, Status]) -> dict[str, float]:
    """Return the expected time of every cell [s].

    It is the mean time of finished cells of the same kind (backbone, size, method, number of tasks
    and steps) or else of all, derived ones apart; empty as long as none is finished. A finished
    cell has its own time.
    """
    times: dict[Any, list[float]] = {}
    for cell in study.cells:
        current = statuses[cell.name]
        if current.result and current.state is State.FINISHED:
            for kind in _kinds(cell, current.config):
                times.setdefault(kind, []).append(current.result["seconds"]["total"])
    expected = {}
    for cell in study.cells:
        current = statuses[cell.name]
        if current.result:
            expected[cell.name] = current.result["seconds"]["total"]
        elif known := [kind for kind in _kinds(cell, current.config) if kind in times]:
            expected[cell.name] = statistics.fmean(times[known[0]])
    return expected


def _kinds(cell: Cell | Derived, config: Config | None) -> list[tuple]:
    """Return what a cell has in common with cells that take as long, most specific first."""
    general = (type(cell).__name__,)
    if config is None:
        return [general, ()]
    model, method = config.model, type(config.peft).__name__
    tasks, steps = len(config.tasks), config.optim.steps
    return [(*general, model.backbone, model.size, method, tasks, steps), general, ()]


def summary(result: Mapping[str, Any]) -> str:
    """Return success by task and time of a finished cell on one line."""
    rates = [
        f"{task} {outcomes.count('1') / len(outcomes):.1%}"
        for task, outcomes in result["outcomes"].items()
    ]
    return f"{', '.join(rates)} in {duration(result['seconds']['total'])}"


def duration(seconds: float) -> str:
    """Return a time in hours and minutes, or in seconds below two minutes."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"
