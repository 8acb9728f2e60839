"""What is known of a robot's states and actions: moments, bounds and quantiles."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.policies.normalization import SMALLEST_SPREAD
from lorasp_jax.storage.digest import DIGEST, sealed, unsealed

NAMES = ("mean", "std", "min", "max", "q01", "q99", "q10", "q90")
"""Statistics that may be known."""
_UNUSED: dict[str, float] = dict(zip(NAMES, (0, 1, -1, 1, -1, 1, -1, 1), strict=True))
"""Values in slots that a robot does not use, where every normalisation is the identity."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Statistics:
    """Statistics of states and of actions by name, `[A]` f32 each. A pytree.

    Attributes:
        state: some of `NAMES`, for states; mean and std at unused slots are 0 and 1.
        action: likewise.
    """

    state: Mapping[str, jax.Array]
    action: Mapping[str, jax.Array]

    @property
    def dim(self) -> int:
        """A, the number of slots."""
        return next(iter(self.state.values())).shape[-1]

    @classmethod
    def measure(
        cls,
        state: np.ndarray,
        action: np.ndarray,
        valid: np.ndarray,
        *,
        slots: Sequence[int],
        dim: int,
    ) -> "Statistics":
        """Statistics of demonstrations; std is at least `SMALLEST_SPREAD`.

        Args:
            state: `[..., J+1]` joints [rad] and gripper [m].
            action: `[..., J+1]` likewise, as the policy shall give them.
            valid: `[...]` bool, False at padding.
            slots: slot of each of the J+1 numbers.
            dim: number of slots, A.

        Raises:
            ValueError: nothing is valid, or the slots do not match the data.
        """
        valid = np.asarray(valid, bool)
        check_slots(slots, dim, np.shape(state)[-1])
        if not valid.any():
            raise ValueError("statistics need at least one valid step.")
        measured = (_measured(np.asarray(values, np.float64)[valid]) for values in (state, action))
        return cls(*measured).placed(slots, dim)

    def placed(self, slots: Sequence[int], dim: int) -> "Statistics":
        """Statistics of a robot's numbers, in a backbone's slots.

        Args:
            slots: slot of each of the robot's J+1 numbers; further ones that the statistics have
                are left out, as files of openpi may be padded.
            dim: number of slots, A.

        Raises:
            ValueError: fewer numbers than slots, or impossible slots.
        """
        check_slots(slots, dim, len(slots))
        if self.dim < len(slots):
            raise ValueError(f"the statistics have {self.dim} numbers, the robot {len(slots)}.")

        def place(known: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
            found = {name: np.full(dim, _UNUSED[name], np.float32) for name in known}
            for name, array in found.items():
                array[list(slots)] = known[name][: len(slots)]
            return {name: jnp.asarray(array) for name, array in found.items()}

        return Statistics(place(self.state), place(self.action))

    def to_json(self) -> str:
        """JSON object of lists, "state_mean" and so on, exact in fp32, and their digest."""
        both = {"state": self.state, "action": self.action}
        found = {
            f"{kind}_{name}": np.asarray(known[name]).tolist()
            for kind, known in both.items()
            for name in NAMES
            if name in known
        }
        return json.dumps(sealed(found), indent=1)

    @classmethod
    def from_json(cls, text: str) -> "Statistics":
        """What `to_json` wrote, or somebody else, without a digest.

        Raises:
            ValueError: not such an object, or not as it was written.
        """
        both: dict[str, dict[str, np.ndarray]] = {"state": {}, "action": {}}
        try:
            found = json.loads(text)
            for key, values in (unsealed(found) if DIGEST in found else found).items():
                kind, _, name = key.partition("_")
                with np.errstate(over="ignore"):  # what is infinite then is refused
                    both[kind][name] = np.asarray(values, np.float32)
        except (
            AttributeError, KeyError, TypeError, ValueError, OverflowError, RecursionError
        ) as error:  # fmt: skip
            raise ValueError(
                f"statistics need lists of numbers state_NAME and action_NAME, got {text[:80]!r} "
                f"({error})."
            ) from error
        return checked(both, "this JSON")


def checked(both: Mapping[str, Mapping[str, np.ndarray]], whose: str) -> Statistics:
    """Statistics of what was read, "state" and "action" each by name.

    Raises:
        ValueError: nothing of one of them, different lengths, numbers that are not finite, or
            a standard deviation below 0.
    """
    arrays = [array for known in both.values() for array in known.values()]
    unknown = sorted({name for known in both.values() for name in known} - set(NAMES))
    wrong = any(array.ndim != 1 or array.shape != arrays[0].shape for array in arrays)
    if unknown or wrong or not all(both.values()):
        raise ValueError(
            f"statistics need lists of one length of {', '.join(NAMES)}, some for state and some "
            f"for action; {whose} is different{f' in {unknown[0]!r}' if unknown else ''}."
        )
    if not all(np.isfinite(array).all() for array in arrays):
        raise ValueError(f"statistics in {whose} are not finite: they were never set.")
    if any((known.get("std", np.zeros(1)) < 0).any() for known in both.values()):
        raise ValueError(f"statistics in {whose} have a standard deviation below 0.")
    state, action = (
        {name: jnp.asarray(array, jnp.float32) for name, array in both[kind].items()}
        for kind in ("state", "action")
    )
    return Statistics(state, action)


def check_slots(slots: Sequence[int], dim: int, length: int) -> None:
    """Raise ValueError unless these are `length` different slots below `dim`."""
    if len(slots) != length or len(set(slots)) != length or not all(0 <= s < dim for s in slots):
        raise ValueError(
            f"{length} numbers need as many different slots below {dim}, got {tuple(slots)}."
        )


def _measured(rows: np.ndarray) -> dict[str, jax.Array]:
    """Of rows `[N, J]` f64."""
    q01, q10, q90, q99 = np.quantile(rows, [0.01, 0.1, 0.9, 0.99], axis=0)
    found = {
        "mean": rows.mean(axis=0),
        "std": np.maximum(rows.std(axis=0), SMALLEST_SPREAD),
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "q01": q01,
        "q99": q99,
        "q10": q10,
        "q90": q90,
    }
    return {name: jnp.asarray(array, jnp.float32) for name, array in found.items()}
