"""Tables of a study's cells, for a dry run and at the end of a run."""

import dataclasses
import functools
from collections import Counter
from collections.abc import Collection, Mapping

from rich.table import Table

from lorasp_jax.config import Config, DataConfig, OptimConfig
from lorasp_jax.study import forecast
from lorasp_jax.study.status import BROKEN, State, Status
from lorasp_jax.study.study import Derived, Study


def dry_run_table(study: Study, names: Collection[str], statuses: Mapping[str, Status]) -> Table:
    """Tabulate method, size, state and expected time of the named cells.

    Settings that depend on results which do not exist yet are shown as "?".
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
        config, steps, parameters = current.config, "?", "?"
        method = type(config.peft).__name__ if config else "?"
        if isinstance(cell, Derived):
            method, steps, parameters = f"from {cell.source}", "0", ""
        elif config:
            steps, parameters = f"{config.optim.steps:,}", f"{trainable_parameters(config):,}"
        time = forecast.duration(times[cell.name]) if cell.name in times else "?"
        table.add_row(cell.name, method, steps, parameters, str(current.state), time)
    return table


def totals(study: Study, names: Collection[str], statuses: Mapping[str, Status]) -> str:
    """Count the named cells by state on one line, with the expected time of the unfinished ones."""
    counts = Counter(statuses[name].state for name in names)
    parts = [f"{counts[state]} {state}" for state in State if counts[state]]
    times = forecast.seconds(study, statuses)
    left = [times[name] for name in names if not statuses[name].result and name in times]
    time = f"; the others take about {forecast.duration(sum(left))} one by one" if left else ""
    return f"{study.name}: {', '.join(parts)}{time}"


def problems(names: Collection[str], statuses: Mapping[str, Status]) -> list[str]:
    """Return a line for every named cell that needs attention or waits."""
    states = {*BROKEN, State.WAITING}
    return [
        f"{name}: {statuses[name].state} {statuses[name].reason}"
        for name in statuses
        if name in names and statuses[name].state in states
    ]


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
    from lorasp_jax.training.base import base_model
    from lorasp_jax.training.cost import preflight

    base, _ = base_model(config, abstract=True)
    return adaptation.count(preflight.abstract_model(config, base.config)).trainable
