"""Logging to Weights & Biases: `--wandb PROJECT`."""

from pathlib import Path
from typing import Self

from lorasp_jax.config import Config
from lorasp_jax.training import records
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import read_json, to_json, write_json

RECORD = "wandb.json"
"""File in a run's folder with the id of the W&B run, which is continued on resume."""


class WeightsAndBiases(Callback):
    """Logs config, metrics, success rates and videos; as a context manager, reports the exit code.

    W&B keeps its own files in the parent of the run's folder and reads its environment variables,
    such as WANDB_MODE=offline.
    """

    def __init__(self, project: str, config: Config, folder: Path) -> None:
        """Start a W&B run, or continue the one recorded in `folder`.

        Raises:
            ValueError: wandb is not installed, or reports an error.
        """
        try:
            import wandb  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise ValueError("--wandb needs the package wandb: pip install wandb") from error
        self._wandb, record = wandb, folder / RECORD
        run_id = read_json(record, {"id": str}).get("id")
        try:
            self._run = wandb.init(
                project=project,
                name=config.name,
                id=run_id,
                resume="allow",
                dir=str(folder.parent.absolute()),
                config=to_json(config),
            )
        except wandb.Error as error:
            raise ValueError(f"Weights & Biases: {' '.join(str(error).split())}") from error
        # W&B's own step counter cannot go back to the step that a run resumes from.
        self._run.define_metric("*", step_metric="step")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Finish the W&B run, waiting for all uploads."""
        self._run.finish(exit_code=int(kind is not None))

    def on_start(self, run: Run) -> None:
        """Record the run id and log the success rates before training."""
        write_json(run.folder / RECORD, {"id": self._run.id})
        before = run.folder / "before.json"
        if before.exists():
            self._log_success(0, read_json(before, records.BEFORE))

    def on_log(self, run: Run, step: int, metrics: dict[str, float]) -> None:  # noqa: ARG002
        """Log the metrics."""
        self._run.log({"step": step, **metrics})

    def on_end(self, run: Run) -> None:
        """Log the rollout videos and the success rates after training."""
        results = read_json(run.folder / "results.json", records.RESULTS)
        after = {task: result["after"] for task, result in results["tasks"].items()}
        self._log_success(run.config.optim.steps, after)
        videos = {
            f"rollout/{task}": self._wandb.Video(str(run.folder / f"rollout_{task}.mp4"))
            for task in after
        }
        self._run.log({"step": run.config.optim.steps, **videos})

    def _log_success(self, step: int, tasks: dict[str, dict[str, float]]) -> None:
        rates = {f"success/{task}": result["success"] for task, result in tasks.items()}
        self._run.log({"step": step, **rates})
