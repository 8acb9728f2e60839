"""What a student with few flow steps learns: objectives for the training step.

The student trains the layers of the flow steps alone. The prefix is the teacher's, computed once
without gradient for both. F(x, t) is the velocity of the student, ε the noise, sg stops gradients.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from lorasp_jax.data.batches import Batch
from lorasp_jax.distill_flow.config import DistillFlowConfig
from lorasp_jax.models import flow_matching
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.sampling import NUM_STEPS
from lorasp_jax.models.transformer.layers import ModelAux, merge_action_aux
from lorasp_jax.training.step import Objective


def of(config: DistillFlowConfig) -> Objective:
    """Return the objective that the config names."""
    if config.distill.loss == "snapflow":
        return SnapFlow()
    return Endpoint(config.evaluation.denoise_steps)


@dataclass(frozen=True)
class Endpoint:
    """The student ends where the teacher does, from the same noise: (Φ_k(ε) - sg Φ'_n(ε))².

    Φ are Euler samplers. For one step this is (F(ε, 1) - sg(ε - Φ'_n(ε)))², the t = 1 case of
    reflow's regression on fixed pairs (arXiv 2209.03003).

    Attributes:
        num_steps: k, flow steps of the student; the teacher takes n = `NUM_STEPS`.
    """

    num_steps: int

    def __call__(
        self, student: Backbone, teacher: Backbone, batch: Batch, noise: jax.Array, _: jax.Array
    ) -> tuple[jax.Array, ModelAux]:
        """Return errors `[B, C, A]` and the adapters' aux, see `training.step.Objective`."""
        prefix, aux, options = _shared(teacher, batch)
        sample = {"noise": noise, **options}
        target, _aux = teacher.run_flow(prefix, num_steps=NUM_STEPS, **sample)
        chunk, action_aux = student.run_flow(prefix, num_steps=self.num_steps, **sample)
        errors = jnp.square(chunk - jax.lax.stop_gradient(target))
        return errors, merge_action_aux(aux, action_aux)


@dataclass(frozen=True)
class SnapFlow:
    """SnapFlow's self-distillation to one step (arXiv 2604.05656), for comparison.

        α (F(x_t, t) - u_t)² + (1 - α) λ (F(ε, 1) - sg ½ [F(ε, 1) + F(x_½, ½)])²
        with x_½ = ε - ½ sg F(ε, 1)

    The target is the two-step Euler sample of the student itself. This lacks the paper's embedding
    of a target time, which needs new parameters, and its limit of ±20 on velocities.

    Attributes:
        share: α, of the flow-matching loss.
        weight: λ, of the consistency loss.
    """

    share: float = 0.5
    weight: float = 0.1

    def __call__(
        self,
        student: Backbone,
        teacher: Backbone,
        batch: Batch,
        noise: jax.Array,
        flow_time: jax.Array,
    ) -> tuple[jax.Array, ModelAux]:
        """Return errors `[B, C, A]` and the adapters' aux, see `training.step.Objective`."""
        prefix, aux, options = _shared(teacher, batch)
        obs, slots, valid = options["obs"], options["slots"], options["action_valid"]
        velocity = lambda x_t, t: student.run_suffix(prefix, obs, x_t, t, valid)  # noqa: E731
        plain, action_aux = flow_matching.loss(
            velocity,
            jax.random.key(0),  # unused, as noise and time are given
            batch.actions,
            slots=slots,
            noise=noise,
            flow_time=flow_time,
        )
        one, two = (
            student.run_flow(prefix, noise=noise, num_steps=n, **options)[0] for n in (1, 2)
        )
        consistency = jnp.square(one - jax.lax.stop_gradient(two))
        errors = self.share * plain + (1 - self.share) * self.weight * consistency
        return errors, merge_action_aux(aux, action_aux)


def _shared(teacher: Backbone, batch: Batch) -> tuple[Any, ModelAux, dict[str, Any]]:
    """Return the prefix, its aux, and what both samplers take besides, as `Backbone.loss` does."""
    prefix, aux = jax.lax.stop_gradient(teacher.run_prefix(batch.observation))
    mask = batch.action_mask
    options = {"slots": mask.any(axis=1, keepdims=True), "action_valid": mask.any(axis=2)}
    return prefix, aux, {"obs": batch.observation, **options}
