"""Progress bars shared by all commands."""

import threading
from collections.abc import Callable
from typing import Any

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
"""Called with the number of items done and the total."""
_QUIET = 30.0  # s
_PERIOD = 600.0
"""Time over which the rate is averaged [s]; no rate is shown until two updates fall within it."""


def bars(console: Console, unit: str, *, per_step: int = 1, shown: bool = True) -> Progress:
    """Make progress bars with counts, a rate and the remaining time.

    Where no bars can be drawn, as in a file or a pipe, a line is printed now and then.

    Args:
        console: console to draw on.
        unit: unit of the rate, such as "episodes".
        per_step: units per step of the bar.
        shown: False hides the bars, for when the console already shows another `Progress`.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        _Rate(unit, per_step),
    )
    return _Bars(*columns, console=console, disable=not shown, speed_estimate_period=_PERIOD)


def collecting(progress: Progress, title: str, stop: threading.Event) -> Report:
    """Make a progress callback that updates a bar.

    The first call, before compilation, adds the bar. Once `stop` is set, the callback raises
    KeyboardInterrupt.
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


class _Bars(Progress):
    """Bars, or else a line at most every `_QUIET` seconds."""

    def __init__(self, *columns: ProgressColumn, **options: Any) -> None:
        super().__init__(*columns, **options)
        self._texts = [column for column in columns if not isinstance(column, BarColumn)]
        self._said = self.get_time()

    def update(self, task_id: TaskID, **changes: Any) -> None:
        super().update(task_id, **changes)
        console, now = self.console, self.get_time()
        if self.disable or console.is_interactive or console.is_jupyter:
            return
        if now - self._said >= _QUIET:
            self._said = now
            texts = [str(column(self._tasks[task_id])) for column in self._texts]
            line = " ".join(filter(None, texts))
            console.print(line, soft_wrap=True, highlight=False, markup=False)


class _Rate(ProgressColumn):
    """The bar's field `rate`, or else units per second; empty before the second update."""

    def __init__(self, unit: str, per_step: int) -> None:
        super().__init__()
        self._unit, self._per_step = unit, per_step

    def render(self, task: Task) -> Text:
        measured = (task.finished_speed or task.speed or 0) * self._per_step
        if not (rate := task.fields.get("rate", measured)):
            return Text("")
        return Text(f"{rate:,.3g} {self._unit}/s" if rate < 100 else f"{rate:,.0f} {self._unit}/s")
