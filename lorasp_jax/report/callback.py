"""Update report.html during a run, and print a summary table at the end."""

import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from rich.table import Table

from lorasp_jax.report.html import phases, speed, success_cell, write_report
from lorasp_jax.training import records
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import STOPPED, read_json, read_metrics, write_json

INTERVAL = 20.0
"""Minimum seconds between reports; a report takes about half a second on one core."""


class Report(Callback):
    """Writes report.html in a background thread while training continues, and once at the end.

    Must come after the callback that writes results.json.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1)
        self._latest: Future | None = None
        self._started = -float("inf")

    def on_start(self, run: Run) -> None:
        """Write the first report, which shows success before training."""
        self._submit(run.folder)

    def on_log(self, run: Run, step: int, metrics: dict[str, float]) -> None:  # noqa: ARG002
        """Update the report unless the latest one is recent or still being written."""
        (run.folder / STOPPED).unlink(missing_ok=True)
        if time.perf_counter() - self._started > INTERVAL and (
            not self._latest or self._latest.done()
        ):
            self._submit(run.folder)

    def on_end(self, run: Run) -> None:
        """Write the final report and print a summary table."""
        self._submit(run.folder).result()
        self._thread.shutdown()
        run.console.print(final_table(run.folder))

    def on_stop(self, run: Run, reason: str) -> None:
        """Write the final report, including the reason why the run stopped."""
        write_json(run.folder / STOPPED, {"reason": reason})
        run.console.print(
            f"report up to this step: {self._submit(run.folder).result()}", markup=False
        )
        self._thread.shutdown()

    def _submit(self, folder: Path) -> Future:
        """Wait for the previous report, raise its error if it failed, and start a new one."""
        if self._latest:
            self._latest.result()
        self._latest = self._thread.submit(write_report, folder)
        self._started = time.perf_counter()
        return self._latest


def final_table(folder: Path) -> Table:
    """Summarize a finished run: success, loss, active rank, parameters, speed and time.

    Raises:
        ValueError: the run is not finished, or its files are damaged.
    """
    results = read_json(folder / "results.json", records.RESULTS)
    if not results:
        raise ValueError(f"no finished run in {folder}: results.json is missing")
    rows = [
        row for row in read_metrics(folder) if "task" in row
    ]  # a row has no loss if all its steps were skipped
    table = Table("", title=folder.name)
    for column in ("before", "after"):
        table.add_column(column, no_wrap=True)
    for task, value in results["tasks"].items():
        before = success_cell(value["before"]) if "before" in value else ""
        table.add_row(task, before, success_cell(value["after"]))
    if results["tasks"]:
        table.add_section()
    if rows:
        first, last = rows[0], rows[-1]
        label = f"flow-matching loss at steps {first['step']:.0f} and {last['step']:.0f}"
        table.add_row(label, f"{first['task']:.4f}", f"{last['task']:.4f}")
    ranks = {f"active rank, {name}": f"{x:.1f}" for name, x in results["active_rank"].items()}
    trainable = f"{results['trainable_parameters']:,} of {results['total_parameters']:,}"
    for label, value in {**ranks, "trainable parameters": trainable, **speed(rows)}.items():
        table.add_row(label, "", value)
    table.add_section()
    for phase, seconds in phases(results["seconds"]).items():
        table.add_row(f"time, {phase}", "", f"{seconds:,.0f} s")
    return table
