"""The state of a run of online learning."""

from dataclasses import dataclass, field
from typing import Any

import jax

from lorasp_jax.reinforce.critic import Critic
from lorasp_jax.reinforce.teacher import Teacher
from lorasp_jax.training.guard import Guard


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Learner:
    """What a run saves and resumes from.

    Attributes:
        step: `[]` int32, number of iterations.
        adapters: trainable parameters, an `nnx.State`.
        guard: statistics that decide which updates to skip.
        opt_state: the optimizer's; that of an actor of the noise is of its layers alone.
        critics: by task.
        rate: `[]` factor of the learning rate, which follows the KL divergence of the iterations.
        teachers: by task; none unless the policy learns from them.
    """

    step: jax.Array
    adapters: Any
    opt_state: Any
    guard: Guard
    critics: dict[str, Critic]
    rate: jax.Array
    teachers: dict[str, Teacher] = field(default_factory=dict)
