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


@contextlib.contextmanager
def bars(console: Console, stop: threading.Event) -> Iterator[Callable[[str, str], Report]]:
    """Progress bars: a function that makes one for a task and a robot, and gives what moves it.

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
            bar = progress.add_task(f"{task}, {robot}: compiling ...", total=None, rate="")
            begun: list[int] = []  # how many there were at the first report

            def report(done: int, total: int) -> None:
                if stop.is_set():
                    raise KeyboardInterrupt
                progress.update(bar, completed=done, total=total)
                begun.append(done)
                if len(begun) > 1:
                    rate = (done - begun[0]) / (progress.tasks[bar].elapsed or 1)
                    text = f"{task}, {robot}: collecting"
                    progress.update(bar, description=text, rate=f"{rate:.1f} episodes/s")

            return report

        yield new_bar
