"""Weights & Biases, if it is installed and asked for: `--wandb PROJECT`."""

from pathlib import Path
from types import TracebackType
from typing import Self

from lorasp_jax.config import Config
from lorasp_jax.training import records
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import read_json, to_json, write_json

RECORD = "wandb.json"
"""File of a run's folder with its id there, under which it goes on."""


class WeightsAndBiases(Callback):
    """Sends config, metrics, success and videos of a run; a context that tells how it ended.

    What W&B writes while it sends lies in the folder that holds the runs' folders. Its own settings
    are those of its environment variables, such as WANDB_MODE=offline.
    """

    def __init__(self, project: str, config: Config, folder: Path) -> None:
        """Begin a run there, or go on with the one of this folder.

        Raises:
            ValueError: wandb is not installed, or refuses.
        """
        try:
            import wandb  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise ValueError("--wandb needs a package: pip install wandb") from error
        self._wandb, record = wandb, folder / RECORD
        known = read_json(record, {"id": str}).get("id")
        try:
            self._run = wandb.init(
                project=project,
                name=config.name,
                id=known,
                resume="allow",
                dir=str(folder.parent.absolute()),
                config=to_json(config),
            )
        except wandb.Error as error:
            raise ValueError(f"Weights & Biases: {' '.join(str(error).split())}") from error
        self._run.define_metric("*", step_metric="step")  # its own counter cannot go back

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Wait until everything is sent."""
        self._run.finish(exit_code=int(kind is not None))

    def on_start(self, run: Run) -> None:
        """Remember the id, and send success before the first step."""
        write_json(run.folder / RECORD, {"id": self._run.id})
        before = run.folder / "before.json"
        if before.exists():
            self._success(0, read_json(before, records.BEFORE))

    def on_log(self, run: Run, step: int, metrics: dict[str, float]) -> None:  # noqa: ARG002
        """Send the metrics."""
        self._run.log({"step": step, **metrics})

    def on_end(self, run: Run) -> None:
        """Send success after the last step and the videos."""
        results = read_json(run.folder / "results.json", records.RESULTS)
        after = {task: result["after"] for task, result in results["tasks"].items()}
        self._success(run.config.optim.steps, after)
        videos = {
            f"rollout/{task}": self._wandb.Video(str(run.folder / f"rollout_{task}.mp4"))
            for task in after
        }
        self._run.log({"step": run.config.optim.steps, **videos})

    def _success(self, step: int, tasks: dict[str, dict[str, float]]) -> None:
        rates = {f"success/{task}": result["success"] for task, result in tasks.items()}
        self._run.log({"step": step, **rates})
