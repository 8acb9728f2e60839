"""Tables of a study's cells, for a dry run and at the end of a run."""

import dataclasses
import functools
from collections import Counter
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

from rich.table import Table

from lorasp_jax.config import Config, DataConfig, OptimConfig
from lorasp_jax.extras.study import forecast
from lorasp_jax.extras.study.status import BROKEN, State, Status
from lorasp_jax.extras.study.study import Derived, Study
from lorasp_jax.peft import LoRA

if TYPE_CHECKING:
    from lorasp_jax.models.config import BackboneConfig


def dry_run_table(study: Study, names: Collection[str], statuses: Mapping[str, Status]) -> Table:
    """Tabulate method, size, state and expected time of the named cells.

    What depends on results that do not exist yet is shown as "?".
    """
    table = Table(title=f"study {study.name}")
    table.add_column("cell", min_width=max(map(len, names), default=0))
    table.add_column("method")
    for column in ("steps", "trainable"):
        table.add_column(column, justify="right")
    table.add_column("state")
    table.add_column("time", justify="right")
    times = forecast.seconds(study, statuses)
    for cell in study.cells:
        if cell.name not in names:
            continue
        current = statuses[cell.name]
        config = current.config or current.guess
        method = type(config.peft).__name__ if config else "?"
        steps, parameters = f"{config.optim.steps:,}" if config else "?", _parameters(current)
        if isinstance(cell, Derived):
            method, steps, parameters = f"from {cell.source}", "0", ""
        time = forecast.duration(times[cell.name]) if cell.name in times else "?"
        table.add_row(cell.name, method, steps, parameters, str(current.state), time)
    return table


def totals(study: Study, names: Collection[str], statuses: Mapping[str, Status]) -> str:
    """Count the named cells by state on one line, with the expected time of the unfinished ones."""
    counts = Counter(statuses[name].state for name in names)
    parts = [f"{counts[state]} {state}" for state in State if counts[state]]
    times = forecast.seconds(study, statuses)
    left = forecast.left(study, names, statuses, (State.RUNNABLE, State.FAILED))
    known = [times[name] for name in left if name in times]
    time = f"; the others take about {forecast.duration(sum(known))} one by one" if known else ""
    return f"{study.name}: {', '.join(parts)}{time}"


def problems(names: Collection[str], statuses: Mapping[str, Status], *, waiting: bool) -> list[str]:
    """Return a line for every named cell that needs attention and, if `waiting`, that waits."""
    states = {*BROKEN, State.WAITING} if waiting else BROKEN
    return [
        f"{name}: {statuses[name].state} {statuses[name].reason}"
        for name in statuses
        if name in names and statuses[name].state in states
    ]


def _parameters(status: Status) -> str:
    """Return the number of trainable parameters of a cell, as far as it is known."""
    if status.result:
        return f"{status.result['trainable_parameters']:,}"
    return f"{trainable_parameters(status.config):,}" if status.config else "?"


def trainable_parameters(config: Config) -> int:
    """Return the number of trainable parameters of a run, from shapes alone.

    Raises:
        ValueError: the config names an unknown backbone, size or target.
    """
    data, optim = DataConfig(), OptimConfig()
    return _trainable_parameters(
        dataclasses.replace(config, name="any", tasks=("any",), seed=0, data=data, optim=optim)
    )


@functools.cache
def _trainable_parameters(config: Config) -> int:
    from lorasp_jax.adapters import adaptation  # imported here: a finished study needs no model
    from lorasp_jax.training.cost import preflight

    # The base does not depend on the method, so few bases are loaded.
    backbone = _backbone(dataclasses.replace(config, peft=LoRA(), targets=(".*",)))
    return adaptation.count(preflight.abstract_model(config, backbone)).trainable


@functools.cache
def _backbone(config: Config) -> "BackboneConfig":
    """Return the architecture of a run's base."""
    from lorasp_jax.training.base import base_model

    return base_model(config, abstract=True)[0].config
