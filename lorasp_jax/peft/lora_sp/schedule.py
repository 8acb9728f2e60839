"""An energy target η that moves while training.

The share of the training that is done lies in the adapter's own parameters, as `progress`, so that
it reaches a layer inside any model, scanned, rematerialised or sharded, is saved and resumed with
it, and changes nothing that is compiled. The optimizer moves it (`scheduling`), never the gradient.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax

from lorasp_jax.kernels.energy_gate import MIN_TARGET, positive
from lorasp_jax.kernels.threshold_search import Ratio, bisected_mask
from lorasp_jax.peft import _fields

PROGRESS = "progress"


@dataclasses.dataclass(frozen=True)
class EnergySchedule:
    """How η goes from a start to its target.

    Raises:
      ValueError: a start or a share outside (0, 1], or an unknown curve.
    """

    start: float = 1.0
    """η at the first step; at 1 nothing is pruned."""
    curve: Literal["linear", "cosine"] = "linear"
    """"cosine": half a period of it, flat at both ends."""
    share: float = 0.5
    """Share of the steps in which it gets there."""

    def __post_init__(self) -> None:
        """Checks the fields."""
        _fields.check_fields(self, "schedule.")
        for name in ("start", "share"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"schedule.{name} must lie in (0, 1], got {getattr(self, name)}.")

    def target(self, progress: jax.Array, end: float) -> jax.Array:
        """η, f32 [].

        Args:
          progress: f32 [], share of the training that is done.
          end: η once `share` of the training is done.
        """
        done = jnp.clip(jax.lax.stop_gradient(progress) / self.share, 0, 1)
        if self.curve == "cosine":
            done = (1 - jnp.cos(math.pi * done)) / 2
        return self.start + (end - self.start) * done


def gate_at(scores: jax.Array, target: jax.Array) -> jax.Array:
    """The mask of `energy_gate`, bool [..., R], for a traced η f32 [].

    As exact as η itself, which is the fp32 number here and not a decimal.
    """
    constant = jnp.abs(jax.lax.stop_gradient(scores.astype(jnp.float32)))
    below_one = bisected_mask(constant, Ratio(jnp.maximum(target, MIN_TARGET), 1))
    return jnp.where(target >= 1, positive(constant), below_one)


class ScheduleState(NamedTuple):
    """Steps taken, int32 [], and the state of the optimizer inside."""

    step: jax.Array
    inner: Any


def scheduling(
    optimizer: optax.GradientTransformation, total_steps: int
) -> optax.GradientTransformation:
    """The optimizer, after each step of which every `progress` is the share of steps taken.

    It wraps the whole optimizer: nothing else decays or moves the value. Wrapping twice is the same
    as once.
    """
    _fields.positive_int("total_steps", total_steps)

    def init(params: Any) -> ScheduleState:
        return ScheduleState(jnp.zeros((), jnp.int32), optimizer.init(params))

    def update(updates: Any, state: Any, params: Any = None) -> Any:
        updates, inner = optimizer.update(updates, state.inner, params)
        done = (state.step + 1) / total_steps

        def move(update: Any, node: Any) -> Any:
            if not _has_progress(node):
                return update
            return {**update, PROGRESS: (done - node[PROGRESS]).astype(node[PROGRESS].dtype)}

        updates = jax.tree.map(move, updates, params, is_leaf=_has_progress)
        return updates, ScheduleState(state.step + 1, inner)

    return optax.GradientTransformation(init, update)


def _has_progress(node: Any) -> bool:
    return isinstance(node, Mapping) and PROGRESS in node
