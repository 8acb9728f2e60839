"""How long cells take, as told by those that are finished."""

import statistics
from collections.abc import Collection, Mapping
from typing import Any

from lorasp_jax.config import Config
from lorasp_jax.extras.study.status import State, Status
from lorasp_jax.extras.study.study import Cell, Derived, Study


def seconds(
    study: Study, statuses: Mapping[str, Status], recent: Collection[str] = (), jobs: int = 1
) -> dict[str, float]:
    """Return the expected time of every cell [s].

    It is the mean time of finished cells of the same kind (backbone, size, method, number of tasks
    and steps) or else of all, derived ones apart; empty as long as none is finished. A finished
    cell has its own time.

    Args:
        study: the study.
        statuses: states of all its cells.
        recent: finished cells that ran as the others will, `jobs` at a time. The times of other
            cells are scaled by how much longer the recent ones of their kinds took; as long as that
            is unknown, by `jobs`, since jobs share a device.
        jobs: cells that run at once.
    """
    old, new = dict[Any, list[float]](), dict[Any, list[float]]()
    for cell in study.cells:
        current = statuses[cell.name]
        if current.result and current.state is State.FINISHED:
            for kind in _kinds(cell, current.config):
                times = new if cell.name in recent else old
                times.setdefault(kind, []).append(current.result["seconds"]["total"])
    new, old = ({kind: statistics.fmean(t) for kind, t in times.items()} for times in (new, old))
    ratios = [new[kind] / old[kind] for kind in new if len(kind) > 1 and old.get(kind)]
    scale = statistics.fmean(ratios) if ratios else jobs
    means = {kind: scale * time for kind, time in old.items()} | new
    expected = {}
    for cell in study.cells:
        current = statuses[cell.name]
        if current.result:
            expected[cell.name] = current.result["seconds"]["total"]
        elif known := [k for k in _kinds(cell, current.config or current.guess) if k in means]:
            expected[cell.name] = means[known[0]]
    return expected


def left(
    study: Study,
    names: Collection[str],
    statuses: Mapping[str, Status],
    states: Collection[State] = (State.RUNNABLE,),
) -> list[str]:
    """Return which of the named cells can still run: those in `states`, and those after them.

    A cell that waits for one that has failed, or is not among the named ones, cannot.
    """
    found: dict[str, None] = {}
    for cell in study.cells:
        state = statuses[cell.name].state
        can_run = state in states or state is State.WAITING
        if can_run and cell.name in names:
            needs = [name for name in cell.needs if statuses[name].state is not State.FINISHED]
            found |= {cell.name: None} if all(name in found for name in needs) else {}
    return [*found]


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
