"""Progress bars of all commands."""

import threading
from collections.abc import Callable

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

Report = Callable[[int, int], None]
"""Called with what is done and what is wanted."""
_PERIOD = 600.0
"""Seconds of which the rate is the mean; there is none where no two updates fall into them."""


def bars(console: Console, unit: str, *, per_step: int = 1, shown: bool = True) -> Progress:
    """Bars with counts, a rate and the remaining time.

    Args:
        console: where they are drawn.
        unit: what is counted, such as "episodes".
        per_step: units to a step of the bar.
        shown: False while other bars are; a terminal shows one group at a time.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        _Rate(unit, per_step),
    )
    return Progress(*columns, console=console, disable=not shown, speed_estimate_period=_PERIOD)


def collecting(progress: Progress, title: str, stop: threading.Event) -> Report:
    """A report that moves a bar, which appears with the first report, before all is compiled.

    Where `stop` is set, a report raises a KeyboardInterrupt.
    """
    bar: TaskID | None = None

    def report(done: int, total: int) -> None:
        nonlocal bar
        if stop.is_set():
            raise KeyboardInterrupt
        if bar is None:
            bar = progress.add_task(f"{title}: compiling ...", total=total, completed=done)
        else:
            progress.update(bar, completed=done, description=f"{title}: collecting")

    return report


class _Rate(ProgressColumn):
    """Units per second; nothing before there are two points in time."""

    def __init__(self, unit: str, per_step: int) -> None:
        super().__init__()
        self._unit, self._per_step = unit, per_step

    def render(self, task: Task) -> Text:
        if not (speed := task.finished_speed or task.speed):
            return Text("")
        rate = speed * self._per_step
        return Text(f"{rate:,.3g} {self._unit}/s" if rate < 100 else f"{rate:,.0f} {self._unit}/s")
