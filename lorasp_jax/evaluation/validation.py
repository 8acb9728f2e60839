"""Measure a run on its held-out episodes while it trains, and keep its best adapters."""

from lorasp_jax.evaluation import held_out_figure
from lorasp_jax.evaluation.held_out import (
    COLUMNS,
    FEW_WINDOWS,
    MAX_WINDOWS,
    HeldOut,
    Windows,
    measure,
    table,
    windows,
)
from lorasp_jax.training import best
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import VALIDATION, write_json


class Validation(Callback):
    """Measures held-out episodes every `evaluation.validate_every` steps and after the last.

    It logs `HeldOut.scalars`. With `keep` "best", the policy with the least action error is the one
    that later callbacks evaluate and export; put this one before them. The measurements are
    repeatable, and the best adapters are on disk, so that a resumed run keeps what an uninterrupted
    one keeps.
    """

    def __init__(self) -> None:
        """Nothing is read before it is needed."""
        self._windows: Windows | None = None
        self._last: HeldOut | None = None

    def on_log(self, run: Run, step: int, metrics: dict[str, float]) -> dict[str, float]:  # noqa: ARG002
        """Measure the policy if it is due, and save its adapters if they are the best so far."""
        if not run.held_out or not run.config.validates(step):
            return {}
        self._last = self._measure(run)
        error = self._last.policy.mean
        run.console.print(
            f"held-out episodes at step {step}: action error {error:.3f}, holding still "
            f"{self._last.hold.mean:.3f}, repeating {self._last.repeat.mean:.3f} (standard "
            f"deviations); loss {self._last.loss:.4f}"
        )
        if run.config.keep == "best" and error < best.error(run.folder):
            best.save(run.folder, run.policy, step, error)
        return self._last.scalars

    def on_end(self, run: Run) -> None:
        """Take the best adapters; write validation.json and a picture per task."""
        if not run.held_out:
            return
        kept = run.config.optim.steps
        if run.config.keep == "best" and best.error(run.folder) < float("inf"):
            kept, run.policy = best.load(run.folder, run.policy)
            run.console.print(f"kept the adapters of step {kept}, the best on held-out episodes")
        found = self._last if self._last and kept == run.config.optim.steps else self._measure(run)
        content = {
            "episodes": [*run.held_out],
            "kept": kept,
            "columns": [*COLUMNS],
            "errors": table(found),
            "horizon": found.policy.horizon.tolist(),
            "instructions": found.instructions,
        }
        write_json(run.folder / VALIDATION, content)
        source, steps = run.recordings, run.config.evaluation.denoise_steps
        assert source is not None
        held_out_figure.write(run.folder, run.policy, source, run.held_out, num_steps=steps)

    def _measure(self, run: Run) -> HeldOut:
        with run.timed("validate"):
            if self._windows is None:
                assert run.recordings is not None  # episodes are held out of a dataset
                limit = MAX_WINDOWS if run.config.scale == "accelerator" else FEW_WINDOWS
                self._windows = windows(run.recordings, run.held_out, run.policy, limit=limit)
            steps = run.config.evaluation.denoise_steps
            return measure(run.policy, self._windows, num_steps=steps)
