"""Steps that would spoil the state are skipped: not finite, or a spike of loss or gradient.

A skipped step leaves parameters, their average and optimizer state as they were; the step count,
and with it the data position and every random stream, goes on. Whether a step counts is decided by
its loss and the norm of its gradient alone, before any update exists. `select` then fuses leaf by
leaf into the update, which overwrites the donated state where it lies; decided by the updates, all
of them would have to be kept beside the whole old state until the last one is known.

Looking at the gradient is enough: clipped to a finite norm it gives AdamW an update of at most a
few learning rates an element, so an update that is not finite comes from a learning rate that no
run can have. The loop stops at it before it saves.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

WINDOW = 100
"""Steps that the running means look back on; no step is a spike before so many have counted."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Guard:
    """What is known of the steps so far; part of the state, so that a resumed run judges alike.

    Attributes:
        counted: `[]` int32, steps that counted.
        in_a_row: `[]` int32, steps skipped since the last one that counted.
        loss: `[]` running mean of the loss over steps that counted.
        grad_norm: `[]` running mean of the gradient's global norm.
    """

    counted: jax.Array
    in_a_row: jax.Array
    loss: jax.Array
    grad_norm: jax.Array

    @staticmethod
    def initial() -> "Guard":
        """Before the first step."""
        # Arrays of their own: each one's memory is given away.
        return Guard(*(jnp.zeros((), kind) for kind in ("int32", "int32", "float32", "float32")))


def judge(
    guard: Guard, loss: jax.Array, grad_norm: jax.Array, spike: float
) -> tuple[jax.Array, Guard]:
    """Whether a step counts, `[]` bool, and what is known after it.

    Args:
        guard: what is known before it.
        loss: `[]`.
        grad_norm: `[]`.
        spike: factor on either running mean beyond which a step is skipped; 0: none is.
    """
    counts = jnp.isfinite(loss) & jnp.isfinite(grad_norm)
    if spike:
        usual = (loss <= spike * guard.loss) & (grad_norm <= spike * guard.grad_norm)
        counts &= usual | (guard.counted < WINDOW)
    share = 1 / jnp.minimum(guard.counted + 1, WINDOW)
    after = Guard(
        guard.counted + 1,
        jnp.zeros_like(guard.in_a_row),
        guard.loss + share * (loss - guard.loss),
        guard.grad_norm + share * (grad_norm - guard.grad_norm),
    )
    skipped = Guard(guard.counted, guard.in_a_row + 1, guard.loss, guard.grad_norm)
    return counts, select(counts, after, skipped)


def select(counts: jax.Array, after: Any, before: Any) -> Any:
    """Leaf by leaf the state after a step that counts, else the one before it."""
    return jax.tree.map(lambda new, old: jnp.where(counts, new, old), after, before)


def summarise(rows: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What is logged of several steps.

    Args:
        rows: metrics by name, `[steps, ...]`, with `in_a_row` as `Guard` has it after each step.

    Returns:
        `[...]` means over the steps that counted, none where none did; "skipped": how many did not.
    """
    counted = rows["in_a_row"] == 0
    names = [name for name in rows if name != "in_a_row"] if counted.any() else []
    means = {name: rows[name][counted].mean(0) for name in names}
    return {**means, "skipped": np.asarray(np.sum(~counted))}
