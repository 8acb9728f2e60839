"""Schedule of the energy target η during training.

The training progress is one of the adapter's parameters, `progress`. It thus reaches the layers of
any model, is saved with the adapter and never triggers recompilation. It has no gradient; only the
optimizer returned by `with_schedule` updates it.
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
    """Schedule from an initial η to the energy target.

    Raises:
      ValueError: `start` or `share` outside (0, 1], or an unknown curve.
    """

    start: float = 1.0
    """Initial η; 1 prunes nothing."""
    curve: Literal["linear", "cosine"] = "linear"
    """Interpolation from `start` to the target; "cosine": half a cosine wave, flat at both ends."""
    share: float = 0.5
    """Fraction of the training steps after which η reaches the target."""

    def __post_init__(self) -> None:
        _fields.check_fields(self, "schedule.")
        for name in ("start", "share"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"schedule.{name} must be in (0, 1], got {getattr(self, name)}")

    def target(self, progress: jax.Array, end: float) -> jax.Array:
        """η at the given progress, f32 [].

        Args:
          progress: f32 [], fraction of the training steps taken.
          end: final η, reached at progress `share`.
        """
        fraction = jnp.clip(jax.lax.stop_gradient(progress) / self.share, 0, 1)
        if self.curve == "cosine":
            fraction = (1 - jnp.cos(math.pi * fraction)) / 2
        return self.start + (end - self.start) * fraction


def scheduled_gate(scores: jax.Array, target: jax.Array) -> jax.Array:
    """The mask of `energy_gate`, bool [..., R], for a traced η f32 [].

    η is exactly its fp32 value here, whereas `energy_gate` reads it as a decimal fraction.
    """
    constant = jnp.abs(jax.lax.stop_gradient(scores.astype(jnp.float32)))
    below_one = bisected_mask(constant, Ratio(jnp.maximum(target, MIN_TARGET), 1))
    return jnp.where(target >= 1, positive(constant), below_one)


class ScheduleState(NamedTuple):
    """Steps taken, int32 [], and the state of the wrapped optimizer."""

    step: jax.Array
    inner: Any


def with_schedule(
    optimizer: optax.GradientTransformation, total_steps: int
) -> optax.GradientTransformation:
    """Wrap an optimizer so that each step sets every `progress` to the fraction of steps taken.

    Wrap the complete optimizer, so that no weight decay or other update changes the value. Wrapping
    twice is equivalent to wrapping once.
    """
    _fields.positive_int("total_steps", total_steps)

    def init(params: Any) -> ScheduleState:
        return ScheduleState(jnp.zeros((), jnp.int32), optimizer.init(params))

    def update(updates: Any, state: Any, params: Any = None) -> Any:
        updates, inner = optimizer.update(updates, state.inner, params)
        progress = (state.step + 1) / total_steps

        def set_progress(update: Any, node: Any) -> Any:
            if not _has_progress(node):
                return update
            return {**update, PROGRESS: (progress - node[PROGRESS]).astype(node[PROGRESS].dtype)}

        updates = jax.tree.map(set_progress, updates, params, is_leaf=_has_progress)
        return updates, ScheduleState(state.step + 1, inner)

    return optax.GradientTransformation(init, update)


def _has_progress(node: Any) -> bool:
    return isinstance(node, Mapping) and PROGRESS in node
