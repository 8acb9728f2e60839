"""Skip training steps whose loss or gradient is non-finite or spikes.

A skipped step leaves parameters, their average and the optimizer state unchanged. The step count
still advances, and with it the data position and the random streams.

The decision to skip depends only on loss and gradient norm, so XLA can fuse `select` into the
in-place update of the donated state. If it depended on the updates, all updates and the whole old
state would have to be in memory at once.

Loss and gradient norm suffice: under AdamW, a gradient clipped to a finite norm changes each
parameter by at most a few times the learning rate. A non-finite update means an absurdly high
learning rate; the loop then stops before saving.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

WINDOW = 100
"""Window of the running means [steps]; spikes are detected only after this many accepted steps."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Guard:
    """Statistics of past steps, saved in the state so that resumed runs skip the same steps.

    Attributes:
        counted: `[]` int32, number of accepted steps.
        in_a_row: `[]` int32, number of steps skipped since the last accepted step.
        loss: `[]` running mean of the loss over accepted steps.
        grad_norm: `[]` running mean of the global gradient norm over accepted steps.
    """

    counted: jax.Array
    in_a_row: jax.Array
    loss: jax.Array
    grad_norm: jax.Array

    @staticmethod
    def initial() -> "Guard":
        """Return the statistics before the first step."""
        # Four separate arrays, because a buffer can be donated only once per call.
        return Guard(*(jnp.zeros((), dtype) for dtype in ("int32", "int32", "float32", "float32")))


def check_step(
    guard: Guard, loss: jax.Array, grad_norm: jax.Array, spike: float
) -> tuple[jax.Array, Guard]:
    """Return whether to accept a step, `[]` bool, and the updated statistics.

    A step is rejected if its loss `[]` or global gradient norm `[]` is non-finite or exceeds
    `spike` times its running mean. With `spike` 0, only non-finite steps are rejected.
    """
    accept = jnp.isfinite(loss) & jnp.isfinite(grad_norm)
    if spike:
        within_range = (loss <= spike * guard.loss) & (grad_norm <= spike * guard.grad_norm)
        accept &= within_range | (guard.counted < WINDOW)
    weight = 1 / jnp.minimum(guard.counted + 1, WINDOW)
    accepted = Guard(
        guard.counted + 1,
        jnp.zeros_like(guard.in_a_row),
        guard.loss + weight * (loss - guard.loss),
        guard.grad_norm + weight * (grad_norm - guard.grad_norm),
    )
    skipped = Guard(guard.counted, guard.in_a_row + 1, guard.loss, guard.grad_norm)
    return accept, select(accept, accepted, skipped)


def select(accept: jax.Array, after: Any, before: Any) -> Any:
    """Return `after` if the step is accepted, else `before`."""
    return jax.tree.map(lambda new, old: jnp.where(accept, new, old), after, before)


def summarize(steps: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the means `[...]` of metrics `[steps, ...]` over the accepted steps, if any.

    The number of skipped steps is added as "skipped". `steps` must include the guard's
    `in_a_row` after each step.
    """
    accepted = steps["in_a_row"] == 0
    names = [name for name in steps if name != "in_a_row"] if accepted.any() else []
    means = {name: steps[name][accepted].mean(0) for name in names}
    return {**means, "skipped": np.asarray(np.sum(~accepted))}
