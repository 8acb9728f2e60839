"""Forms of trained policies, as they are and trained on for a few steps."""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from lorasp_jax.data.batches import Batch
from lorasp_jax.extras.deployment import healing, measurement, variants
from lorasp_jax.extras.study import Derived
from lorasp_jax.extras.study.held_out import held_out_demonstrations, shared_demonstrations
from lorasp_jax.models import flow_matching
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.transformer.layers import ModelAux, merge_action_aux
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.demonstrations import Demonstrations
from lorasp_jax.training.run import Run
from studies.few.judge import judge as judge_scenes
from studies.where_it_pays import names, page, sequences

Heal = Callable[[Policy], Policy]
_FORMS = {"taught": "merged", "by_task": "merged", "lora": "merged"}
"""How forms are made that are not `variants.FORMS`."""


def cells(backbone: str, seed: int, pool: int, steps: int) -> Iterator[Derived]:
    """Yield the forms of a seed; healed ones have trained on for some steps."""
    for form, (method, _) in page.FORMS.items():
        for healed in (0, steps):
            if form in (page.MADE if healed else page.HEALED):
                continue
            evaluate = functools.partial(judge, form=form, steps=healed, pool=pool)
            source = names.cell(backbone, method, names.WIDE, seed)
            name = names.form(backbone, form, healed > 0, seed)
            settings = {"form": form, "steps": healed, "rate": healing.RATE, "pool": pool}
            yield Derived(name, source, settings=settings, evaluate=evaluate)


def judge(run: Run, form: str, steps: int, pool: int) -> dict[str, Any]:
    """Return the outcomes of a form of the run's policy, and the `bytes` of its weights.

    "taught" is merged after the policy's own velocities have taught it in place of demonstrations.
    "by_task" is a policy for each task, which shares the steps; `bytes` is the sum.
    """
    settings, study_folder = run.config, run.folder.parents[3]
    held_out = held_out_demonstrations(study_folder, settings)
    every = shared_demonstrations(study_folder, pool, settings)
    groups = [(task,) for task in settings.tasks] if form == "by_task" else [settings.tasks]
    options = {"objective": Taught(run.policy.model) if form == "taught" else None}
    options |= {"steps": max(steps // len(groups), 1)}
    outcomes, size = {}, 0
    for tasks in groups:
        shown = dataclasses.replace(run, config=dataclasses.replace(settings, tasks=tasks))
        counts = {task: every[task].num_episodes for task in tasks}
        shown.episodes = sequences.some(every, counts)
        heal = functools.partial(healing.train_on, run=shown, **options) if steps else None
        shown.policy = _in_form(run.policy, form, {task: held_out[task] for task in tasks}, heal)
        outcomes |= judge_scenes(shown, ("recorded",))["outcomes"]
        size += measurement.weight_bytes(shown.policy)
    return {"outcomes": outcomes, "bytes": size}


def _in_form(policy: Policy, form: str, held_out: Demonstrations, heal: Heal | None) -> Policy:
    kind, _, base = (_FORMS.get(form) or form).partition("_")
    return variants.on_base(variants.in_form(policy, kind, held_out, heal), base or "bf16")


@dataclass(frozen=True, eq=False)
class Taught:
    """The objective (F(x_t, t) - sg F'(x_t, t))², where F' is the velocity of a teacher."""

    teacher: Backbone

    def __call__(
        self, student: Backbone, _: Backbone, batch: Batch, noise: jax.Array, flow_time: jax.Array
    ) -> tuple[jax.Array, ModelAux]:
        """Return errors `[B, C, A]` and the adapters' aux, see `training.step.Objective`."""
        obs, mask = batch.observation, batch.action_mask
        x_t, _velocity = flow_matching.interpolate(noise, batch.actions, flow_time)
        x_t = jnp.where(mask.any(axis=1, keepdims=True), x_t, 0)
        target = jax.lax.stop_gradient(self.teacher.velocity(obs, x_t, flow_time))
        prefix, aux = student.run_prefix(obs)
        velocity, action_aux = student.run_suffix(prefix, obs, x_t, flow_time, mask.any(axis=2))
        return jnp.square(velocity - target), merge_action_aux(aux, action_aux)
