"""Let the policy of a finished cell learn from success."""

import dataclasses
import functools
import json
from dataclasses import dataclass
from typing import Any

from envs import Randomization
from lorasp_jax.config import OptimConfig
from lorasp_jax.evaluation.callback import Evaluation
from lorasp_jax.extras.study import Derived
from lorasp_jax.extras.study.run_cell import simulated
from lorasp_jax.extras.study.study import Evaluate
from lorasp_jax.peft import Method
from lorasp_jax.peft.settings import to_settings
from lorasp_jax.reinforce import loop, start
from lorasp_jax.reinforce.config import Learning, ReinforceConfig
from lorasp_jax.training.run import Run
from lorasp_jax.training.run_folder import read_metrics
from studies.few import judge as scenes
from studies.reinforce import page

_RECORDED = ("step", "minutes", "environment_steps")


@dataclass(frozen=True)
class Trial:
    """How a policy learns from success.

    Attributes:
        every: iterations between evaluations.
        method: of new adapters, after those of the start are merged; None: those learn further.
        scene: what the episodes of learning draw; None: nothing.
        tasks: that are learned; empty: all of the start.
    """

    learning: Learning
    optim: OptimConfig
    every: int
    method: Method | None = None
    scene: Randomization | None = None
    tasks: tuple[str, ...] = ()

    def describe(self) -> dict[str, Any]:
        """Return all settings as JSON values."""
        method = to_settings(self.method) if self.method else None
        name = {"name": method.pop("method")} if method else {}
        found = json.loads(json.dumps(dataclasses.asdict(self) | {"method": method}))
        for setting in ("scene", "tasks"):
            if not getattr(self, setting):
                del found[setting]  # as in results from before there was one
        if self.learning.exploration == "actions":  # likewise
            del found["learning"]["exploration"], found["learning"]["noise_level"]
        return {"trial": found | name}

    def config(self, run: Run) -> ReinforceConfig:
        """Return the config for a derived cell, whose source is the start of the same seed."""
        source = run.folder.parents[1] / "start" / run.folder.name
        adapters = "merge" if self.method else "continue"
        evaluation = dataclasses.replace(run.config.evaluation, before=True, every=self.every)
        fields = vars(run.config) | {
            "peft": self.method or run.config.peft,
            "tasks": self.tasks or run.config.tasks,
            "optim": self.optim,
            "evaluation": evaluation,
            "log_every": 1,
            "checkpoint_every": self.optim.steps,
            "online": dataclasses.replace(self.learning, start=str(source), adapters=adapters),
        }
        if self.scene:
            fields["scene"] = self.scene
        changed = self.scene.changed() if self.scene else {}
        given = [f"scene.{name}" for name in changed] + ["tasks"] * bool(self.tasks)
        return start.resolve(ReinforceConfig(**fields), given)


def learned(trial: Trial, backbone: str, count: int, name: str, seed: int) -> Derived:
    """Return a policy that starts from that of N demonstrations and learns from success."""
    evaluate = functools.partial(judge, trial=trial)
    return derived(backbone, count, name, seed, trial.describe(), evaluate)


def derived(
    backbone: str, count: int, name: str, seed: int, settings: dict[str, Any], evaluate: Evaluate
) -> Derived:
    """Return a cell whose source is the start with N demonstrations."""
    name, source = (page.cell(backbone, count, policy, seed) for policy in (name, "start"))
    return Derived(name, source, settings=settings, evaluate=evaluate, measured=False)


def judge(run: Run, trial: Trial) -> dict[str, Any]:
    """Return what simulation says of the policy that has learned, and its progress.

    That is a row per iteration: minutes, environment steps, and success by task of the policy's and
    the teachers' own episodes and, if evaluated, on fixed layouts, in the scenes of learning, as
    `before` is. `shifted` has the outcomes in a shifted scene, such as "after/pour", if all tasks
    were learned. If teachers taught some, `before` and `outcomes` have the others, too.
    """
    folder = run.folder / "learned"
    folder.mkdir(exist_ok=True)
    after = start.load(trial.config(run), folder, run.console, 0.0)
    loop.train(after, [start.PolicyExport(), Evaluation(media=False)], resume=True)
    kinds = ("success/", "rollout/", "teacher/", "active_rank")
    progress = [
        {k: round(x, 4) for k, x in row.items() if k in _RECORDED or k.startswith(kinds)}
        for row in read_metrics(folder)
    ]
    found = simulated(after)
    if trial.scene:  # its evaluation drew scenes, too
        found["outcomes"] = scenes.outcomes(after, "recorded")
    found |= {"progress": progress}
    if not trial.tasks:
        found["shifted"] = _shifted(run, after)
    elif trial.learning.method == "teacher":
        for when, policy in (("before", run), ("outcomes", after)):
            found[when] = scenes.outcomes(policy, "recorded", run.config.tasks)
    return found


def _shifted(run: Run, after: Run) -> dict[str, str]:
    return {
        f"{when}/{task}": outcomes
        for when, policy in (("before", run), ("after", after))
        for task, outcomes in scenes.outcomes(policy, "shifted").items()
    }
