"""Update report.html during a run."""

import time
from pathlib import Path

from lorasp_jax.report.html import write_report
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import STOPPED, write_json

INTERVAL = 30.0
"""Minimum seconds between reports, each of which takes about half a second on one core."""


class Report(Callback):
    """Writes report.html during training, and once at the end.

    Must come after the callback that writes results.json.
    """

    def __init__(self) -> None:
        self._written = -float("inf")

    def on_start(self, run: Run) -> None:
        """Write the first report, which shows success before training."""
        self._write(run.folder)

    def on_log(self, run: Run, step: int, metrics: dict[str, float]) -> None:  # noqa: ARG002
        """Update the report unless the latest one is recent."""
        (run.folder / STOPPED).unlink(missing_ok=True)
        if time.perf_counter() - self._written > INTERVAL:
            self._write(run.folder)

    def on_end(self, run: Run) -> None:
        """Write the final report."""
        self._write(run.folder)

    def on_stop(self, run: Run, reason: str) -> None:
        """Write the final report, including the reason why the run stopped."""
        write_json(run.folder / STOPPED, {"reason": reason})
        run.console.print(f"report up to this step: {self._write(run.folder)}", markup=False)

    def _write(self, folder: Path) -> Path:
        self._written = time.perf_counter()
        return write_report(folder)
