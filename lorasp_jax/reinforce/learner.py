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
        critics: by task.
        rate: `[]` factor of the learning rate, which follows the KL divergence of the iterations.
        teachers: by task; none if the adapters learn from success themselves.
    """

    step: jax.Array
    adapters: Any
    opt_state: Any
    guard: Guard
    critics: dict[str, Critic]
    rate: jax.Array
    teachers: dict[str, Teacher] = field(default_factory=dict)
