"""Let the policy of a finished cell learn from success."""

import dataclasses
import json
from dataclasses import dataclass
from typing import Any

from lorasp_jax.config import OptimConfig
from lorasp_jax.evaluation.callback import Evaluation
from lorasp_jax.extras.study.run_cell import simulated
from lorasp_jax.peft import Method
from lorasp_jax.reinforce import loop, start
from lorasp_jax.reinforce.config import Learning, ReinforceConfig
from lorasp_jax.training.run import Run
from lorasp_jax.training.run_folder import read_metrics

_RECORDED = ("step", "minutes", "environment_steps")


@dataclass(frozen=True)
class Trial:
    """How a policy learns from success.

    Attributes:
        every: iterations between evaluations.
        method: of new adapters, after those of the start are merged; None: those learn further.
    """

    learning: Learning
    optim: OptimConfig
    every: int
    method: Method | None = None

    def describe(self) -> dict[str, Any]:
        """Return all settings as JSON values."""
        name = {"name": self.method.name} if self.method else {}
        return {"trial": json.loads(json.dumps(dataclasses.asdict(self))) | name}

    def config(self, run: Run) -> ReinforceConfig:
        """Return the config for a derived cell, whose source is the start of the same seed."""
        source = run.folder.parents[1] / "start" / run.folder.name
        adapters = "merge" if self.method else "continue"
        evaluation = dataclasses.replace(run.config.evaluation, before=True, every=self.every)
        fields = {x.name: getattr(run.config, x.name) for x in dataclasses.fields(run.config)}
        fields |= {
            "peft": self.method or run.config.peft,
            "optim": self.optim,
            "evaluation": evaluation,
            "log_every": 1,
            "checkpoint_every": self.optim.steps,
            "online": dataclasses.replace(self.learning, start=str(source), adapters=adapters),
        }
        return start.resolve(ReinforceConfig(**fields), ())


def judge(run: Run, trial: Trial) -> dict[str, Any]:
    """Return what simulation says of the policy that has learned, and its progress.

    That is a row per iteration: minutes, environment steps, and success by task of the policy's and
    the teachers' own episodes and, if evaluated, on fixed layouts.
    """
    folder = run.folder / "learned"
    folder.mkdir(exist_ok=True)
    learned = start.load(trial.config(run), folder, run.console, 0.0)
    loop.train(learned, [start.PolicyExport(), Evaluation(media=False)], resume=True)
    kinds = ("success/", "rollout/", "teacher/", "active_rank")
    progress = [
        {k: round(x, 4) for k, x in row.items() if k in _RECORDED or k.startswith(kinds)}
        for row in read_metrics(folder)
    ]
    return {**simulated(learned), "progress": progress}
