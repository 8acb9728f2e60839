"""Proximal policy optimization (PPO, arXiv 1707.06347): its loss, and a rate that fits."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.reinforce import noise

_FACTOR = 1.5
"""By how much an iteration changes the learning rate; our choice."""
_LARGEST = 64.0
"""Bound of the product of these factors, and of its inverse; our choice."""


class Samples(NamedTuple):
    """N chunks of C actions from a policy, to learn from.

    Attributes:
        actions: `[N, C, A]`.
        advantages: `[N, C]`.
        valid: `[N, C]` bool, the actions to learn from.
        mean: `[N, C, A]` of the policy that acted.
    """

    actions: jax.Array
    advantages: jax.Array
    valid: jax.Array
    mean: jax.Array


def clipped_surrogate(
    mean: jax.Array,
    samples: Samples,
    spread: noise.Spread,
    slots: np.ndarray,
    clip: float,
    num_valid: jax.Array | None = None,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return PPO's loss (eq. 7), with one probability ratio per action, and metrics.

    Args:
        mean: `[N, C, A]` of the policy that learns.
        samples: the loss is the mean over their valid actions.
        spread: of the noise.
        slots: `[A]` bool, the executed ones.
        clip: largest deviation of the ratio from 1 that is rewarded.
        num_valid: overrides the number of valid actions.
    """
    actions, advantages, valid, old = samples
    new, before = (noise.log_prob(x, actions, spread, slots) for x in (mean, old))
    ratio = jnp.exp(new - before)
    num_valid = jnp.sum(valid) if num_valid is None else num_valid
    average = lambda x: jnp.sum(x * valid) / jnp.maximum(num_valid, 1)  # noqa: E731
    clipped = jnp.clip(ratio, 1 - clip, 1 + clip)
    return -average(jnp.minimum(ratio * advantages, clipped * advantages)), {
        "kl": average(noise.divergence(mean, old, spread, slots)),
        "clipped": average(clipped != ratio),
        "ratio": average(ratio),
    }


def adapted(rate: jax.Array, kl: jax.Array | float, allowed: float) -> jax.Array:
    """Return a factor of the learning rate, adapted so that iterations end near a divergence."""
    factor = jnp.where(kl < allowed / 2, _FACTOR, jnp.where(kl <= allowed, 1.0, 1 / _FACTOR))
    return jnp.clip(rate * factor, 1 / _LARGEST, _LARGEST)
