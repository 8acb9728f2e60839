"""Progress bars of a run: what is done, how fast, and how long it will still take."""

from rich.console import Console
from rich.progress import Progress, ProgressColumn, Task
from rich.text import Text

_PERIOD = 600.0
"""Seconds of which the rate is the mean; there is none where no two updates fall into them."""


def bars(console: Console, unit: str, *, per_step: int = 1, shown: bool = True) -> Progress:
    """Bars that show, beside share and remaining time, a rate.

    Args:
        console: where they are drawn.
        unit: what is counted, such as "episodes".
        per_step: units to a step of the bar.
        shown: False while other bars are; a terminal shows one group at a time.
    """
    columns = (*Progress.get_default_columns(), _Rate(unit, per_step))
    return Progress(*columns, console=console, disable=not shown, speed_estimate_period=_PERIOD)


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
