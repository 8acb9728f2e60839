"""report.html while a run goes on, and what it came to in the terminal at its end."""

import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from rich.table import Table

from lorasp_jax.report.html import speed, success_cell, write_report
from lorasp_jax.training import records
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import STOPPED, read_json, read_metrics, write_json

EVERY = 20.0
"""Seconds from one report to the next; one takes about half a second of a core."""


class Report(Callback):
    """Writes report.html in a thread, which training does not wait for; at the end, the last one.

    Comes after the callback that writes results.json.
    """

    def __init__(self) -> None:
        """Nothing is written yet."""
        self._pool = ThreadPoolExecutor(1)
        self._last: Future | None = None
        self._written = -float("inf")

    def on_start(self, run: Run) -> None:
        """Success before the first step."""
        self._begin(run.folder)

    def on_log(self, run: Run, step: int, metrics: dict[str, float]) -> None:  # noqa: ARG002
        """What is new, if the last report is some time ago."""
        (run.folder / STOPPED).unlink(missing_ok=True)
        if time.perf_counter() - self._written > EVERY and (not self._last or self._last.done()):
            self._begin(run.folder)

    def on_end(self, run: Run) -> None:
        """The last report, and a table in the terminal."""
        self._begin(run.folder).result()
        self._pool.shutdown()
        run.console.print(final_table(run.folder))

    def on_stop(self, run: Run, reason: str) -> None:
        """The last report, which says why there is no more."""
        write_json(run.folder / STOPPED, {"reason": reason})
        run.console.print(f"what led to it: {self._begin(run.folder).result()}", markup=False)
        self._pool.shutdown()

    def _begin(self, folder: Path) -> Future:
        """Begin a report once the one before is written; raises what went wrong with that."""
        if self._last:
            self._last.result()
        self._last, self._written = self._pool.submit(write_report, folder), time.perf_counter()
        return self._last


def final_table(folder: Path) -> Table:
    """Success, loss, speed, active rank and time of the finished run in a folder.

    Raises:
        ValueError: the run is not finished, or its files are damaged.
    """
    results = read_json(folder / "results.json", records.RESULTS)
    if not results:
        raise ValueError(f"{folder} holds no finished run: there is no results.json")
    rows = [row for row in read_metrics(folder) if "task" in row]  # not all steps were skipped
    table = Table("", title=folder.name)
    for column in ("before", "after"):
        table.add_column(column, no_wrap=True)
    for task, value in results["tasks"].items():
        table.add_row(task, success_cell(value["before"]), success_cell(value["after"]))
    if results["tasks"]:
        table.add_section()
    if rows:
        first, last = rows[0], rows[-1]
        at = f"flow-matching loss at steps {first['step']:.0f} and {last['step']:.0f}"
        table.add_row(at, f"{first['task']:.4f}", f"{last['task']:.4f}")
    ranks = {f"active rank, {name}": f"{x:.1f}" for name, x in results["active_rank"].items()}
    trained = f"{results['trainable_parameters']:,} of {results['total_parameters']:,}"
    for label, value in {**ranks, "parameters that train": trained, **speed(rows)}.items():
        table.add_row(label, "", value)
    table.add_section()
    for phase, seconds in results["seconds"].items():
        table.add_row(f"time, {phase}", "", f"{seconds:,.0f} s")
    return table
