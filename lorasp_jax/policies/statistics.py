"""Statistics of a robot's states and actions: moments, bounds and quantiles."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.base import json_values
from lorasp_jax.base.digest import DIGEST, verify_digest, with_digest
from lorasp_jax.base.files import as_value_error, parse_json
from lorasp_jax.policies.normalization import MIN_SPREAD

NAMES = ("mean", "std", "min", "max", "q01", "q99", "q10", "q90")
"""Names of all supported statistics."""
_BOUNDS = (("min", "max"), ("q01", "q99"), ("q10", "q90"))
_UNUSED: dict[str, float] = dict(zip(NAMES, (0, 1, -1, 1, -1, 1, -1, 1), strict=True))
"""Statistics of unused slots. They make every normalization mode the identity, up to its guard
against zero."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Statistics:
    """Statistics of states and of actions. A pytree.

    Attributes:
        state: f32 arrays by name, for some of `NAMES`. They have the robot's length, `[J+1]`,
            before `to_slots` and `[A]` after it; unused slots then have mean 0 and std 1.
        action: the same for actions, whose length before `to_slots` may be another.
    """

    state: Mapping[str, jax.Array]
    action: Mapping[str, jax.Array]

    @property
    def dim(self) -> int:
        """Length of the state's arrays: A, or J+1 before `to_slots`."""
        return next(iter(self.state.values())).shape[-1]

    @property
    def action_length(self) -> int:
        """Length of the action's arrays: A, or that of the robot's actions before `to_slots`."""
        return next(iter(self.action.values())).shape[-1]

    @classmethod
    def measure(
        cls,
        state: np.ndarray,
        action: np.ndarray,
        valid: np.ndarray,
        *,
        slots: Sequence[int],
        dim: int,
        action_slots: Sequence[int] | None = None,
    ) -> "Statistics":
        """Compute the statistics of demonstrations; std is at least `MIN_SPREAD`.

        Args:
            state: `[..., J+1]` joints [rad] and gripper [m].
            action: `[..., J+1]`, or of another length: actions as the policy predicts them,
                absolute or relative to the state.
            valid: `[...]` bool, False at padding.
            slots: slots of the state's dimensions.
            dim: number of slots, A.
            action_slots: slots of the action's dimensions; None: those of the state's.

        Raises:
            ValueError: no step is valid, or the slots do not match the data.
        """
        valid = np.asarray(valid, bool)
        action_slots = slots if action_slots is None else action_slots
        check_slots(slots, dim, np.shape(state)[-1])
        check_slots(action_slots, dim, np.shape(action)[-1])
        if not valid.any():
            raise ValueError("statistics need at least one valid step")
        moments = (_measure(np.asarray(values, np.float64)[valid]) for values in (state, action))
        return cls(*moments).to_slots(slots, dim, action_slots)

    def to_slots(
        self, slots: Sequence[int], dim: int, action_slots: Sequence[int] | None = None
    ) -> "Statistics":
        """Move a robot's statistics into a backbone's slots.

        Args:
            slots: slots of the state's dimensions. Further dimensions of the statistics are
                dropped, because openpi pads its files.
            dim: number of slots, A.
            action_slots: slots of the action's dimensions; None: those of the state's.

        Raises:
            ValueError: fewer dimensions than slots, or invalid slots.
        """

        def move(stats: Mapping[str, jax.Array], slots: Sequence[int]) -> dict[str, jax.Array]:
            check_slots(slots, dim, len(slots))
            length = next(iter(stats.values())).shape[-1]
            if length < len(slots):
                raise ValueError(f"statistics need {len(slots)} dimensions, got {length}")
            moved = {name: np.full(dim, _UNUSED[name], np.float32) for name in stats}
            for name, array in moved.items():
                array[list(slots)] = stats[name][: len(slots)]
            return {name: jnp.asarray(array) for name, array in moved.items()}

        action_slots = slots if action_slots is None else action_slots
        return Statistics(move(self.state, slots), move(self.action, action_slots))

    def to_json(self) -> str:
        """Return a JSON object: lists such as "state_mean", exact in fp32, and a digest."""
        both = {"state": self.state, "action": self.action}
        lists = {
            f"{kind}_{name}": np.asarray(stats[name]).tolist()
            for kind, stats in both.items()
            for name in NAMES
            if name in stats
        }
        return json.dumps(with_digest(lists), indent=1)

    @classmethod
    def from_json(cls, text: str) -> "Statistics":
        """Parse the output of `to_json`. The digest may be missing.

        Raises:
            ValueError: invalid content, or the digest does not match.
        """
        both: dict[str, dict[str, np.ndarray]] = {"state": {}, "action": {}}
        with as_value_error(Path("this JSON of statistics")), np.errstate(over="ignore"):
            json_values.check(content := parse_json(text), {})
            content = verify_digest(content) if DIGEST in content else content
            json_values.check(content, {str: [float]})
            for key, values in content.items():
                kind, _, name = key.partition("_")
                both[kind][name] = np.asarray(values, np.float32)  # `validate` refuses overflows
        return validate(both, "this JSON")


def validate(both: Mapping[str, Mapping[str, np.ndarray]], source: str) -> Statistics:
    """Create statistics from arrays by kind ("state", "action") and name.

    Raises:
        ValueError: no statistics of one kind, unknown names, different lengths within a kind,
            values that are not finite, a negative standard deviation or a lower bound above the
            upper one; the message names `source`.
    """
    arrays = [array for stats in both.values() for array in stats.values()]
    names = {name for stats in both.values() for name in stats}
    if not (all(both.values()) and names <= set(NAMES)):
        raise ValueError(f"{source} must have state and action statistics among {', '.join(NAMES)}")
    if any(array.ndim != 1 for array in arrays) or any(
        len({array.shape for array in stats.values()}) > 1 for stats in both.values()
    ):
        raise ValueError(f"the statistics of each kind in {source} must be lists of equal length")
    negative = any((stats.get("std", np.zeros(1)) < 0).any() for stats in both.values())
    if negative or not all(np.isfinite(array).all() for array in arrays):
        raise ValueError(f"statistics in {source} must be finite, and no std negative")
    for kind, stats in both.items():
        for low, high in _BOUNDS:
            if low in stats and high in stats and (stats[low] > stats[high]).any():
                raise ValueError(f"statistics in {source} have a {low} above {high} in {kind}")
    state, action = (
        {name: jnp.asarray(array, jnp.float32) for name, array in both[kind].items()}
        for kind in ("state", "action")
    )
    return Statistics(state, action)


def check_slots(slots: Sequence[int], dim: int, length: int) -> None:
    """Raise ValueError unless `slots` are `length` distinct slots below `dim`."""
    if len(slots) != length or len(set(slots)) != length or not all(0 <= s < dim for s in slots):
        raise ValueError(f"slots must be {length} distinct integers below {dim}, got {slots}")


def _measure(rows: np.ndarray) -> dict[str, jax.Array]:
    """Compute the statistics of rows `[N, J+1]` f64."""
    q01, q10, q90, q99 = np.quantile(rows, [0.01, 0.1, 0.9, 0.99], axis=0)
    stats = {
        "mean": rows.mean(axis=0),
        "std": np.maximum(rows.std(axis=0), MIN_SPREAD),
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "q01": q01,
        "q99": q99,
        "q10": q10,
        "q90": q90,
    }
    return {name: jnp.asarray(array, jnp.float32) for name, array in stats.items()}
