"""Update report.html during a run."""

import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from lorasp_jax.report.html import write_report
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import STOPPED, write_json

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
        """Write the final report."""
        self._submit(run.folder).result()
        self._thread.shutdown()

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
