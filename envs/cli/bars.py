"""Progress bars of the command line, one for each task and robot."""

import contextlib
import threading
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

Report = Callable[[int, int], None]
"""Called with the episodes that are done and those that are wanted."""


def _rate(episodes: int, seconds: float) -> str:
    """Episodes a second, or seconds an episode where those are more."""
    if not episodes:
        return ""
    if episodes < seconds:
        return f"{seconds / episodes:.1f} s an episode"
    return f"{episodes / seconds:.1f} episodes/s"


@contextlib.contextmanager
def bars(console: Console, stop: threading.Event) -> Iterator[Callable[[str, str], Report]]:
    """Progress bars: a function that makes one for a task and a robot, and gives what moves it.

    A bar is seen from its first report on, before which a task or robot may be refused.
    Where `stop` is set, a report raises a KeyboardInterrupt.
    """
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:

        def new_bar(task: str, robot: str) -> Report:
            text = f"{task}, {robot}: compiling ..."
            bar = progress.add_task(text, total=None, rate="", visible=False)
            reports: list[tuple[int, float]] = []  # what was done, and when

            def report(done: int, total: int) -> None:
                if stop.is_set():
                    raise KeyboardInterrupt
                progress.update(bar, completed=done, total=total, visible=True)
                reports.append((done, progress.tasks[bar].elapsed or 0.0))
                if len(reports) > 1:  # the second comes after all is compiled and says no speed
                    before, since = reports[1]
                    rate = _rate(done - before, reports[-1][1] - since)
                    progress.update(bar, description=f"{task}, {robot}: collecting", rate=rate)

            return report

        yield new_bar
