"""Exploration: Gaussian noise around the chunk that the deterministic sampler would return.

Given an observation o and the initial noise ε of the flow, the chunk of the sampler is a function
μ(o, ε). The policy that explores executes actions from N(μ, s² K), so that the probability of an
action is exact with any number of flow steps, and the sampler without noise is its mean. Its noise
depends on no parameter.

Noise that is new in every action averages out over a chunk: the arm shakes and explores little.
With correlation c, that of action i and j of a chunk is K = c^|i-j|, a process of first order:
given the earlier actions of the chunk, the density of each is Gaussian, too.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.policies.processor import Processor
from lorasp_jax.reinforce.config import Learning


class Spread(NamedTuple):
    """Distribution of the noise.

    Attributes:
        std: s, the standard deviation of each action [normalized action units], or `[N, 1]`, that
            of each chunk.
        correlation: c, that of successive actions of a chunk, below 1.
    """

    std: float | jax.Array
    correlation: float | jax.Array

    @classmethod
    def of(cls, learning: Learning) -> "Spread":
        """Return the distribution that the config names; of `flow_sde`, that of step 0."""
        if learning.exploration == "sde":
            return cls(learning.noise_level, 0.0)
        return cls(learning.std, learning.correlation)

    def scales(self, length: int) -> jax.Array:
        """Return standard deviations of actions given the earlier ones, `[length, 1]` or
        `[N, length, 1]`."""
        later = self.std * jnp.sqrt(1 - jnp.square(self.correlation))
        return jnp.where(jnp.arange(length) == 0, self.std, later)[..., None]


def action_slots(processor: Processor) -> np.ndarray:
    """Return the mask of the slots that the robot executes, `[A]` bool: only these get noise."""
    return np.isin(np.arange(processor.statistics.dim), processor.action_slots)


def explore(key: jax.Array, mean: jax.Array, spread: Spread, slots: np.ndarray) -> jax.Array:
    """Draw chunks `[..., C, A]` around their means; do not reuse `key`."""
    steps = np.arange(mean.shape[-2])
    past = steps[:, None] - steps
    decay = jnp.where(past >= 0, jnp.power(spread.correlation, jnp.maximum(past, 0)), 0)
    drawn = spread.scales(len(steps)) * jax.random.normal(key, mean.shape)
    return mean + jnp.einsum("ij,...ja->...ia", decay, drawn, precision="highest") * slots


def log_prob(mean: jax.Array, actions: jax.Array, spread: Spread, slots: np.ndarray) -> jax.Array:
    """Return the log-density `[..., C]` of actions `[..., C, A]` in the executed slots `[A]`, of
    each given the earlier ones."""
    scales = spread.scales(mean.shape[-2])[..., 0]
    normalizer = slots.sum() * (jnp.log(scales) + 0.5 * np.log(2 * np.pi))
    return -_energy(actions - mean, spread, slots) - normalizer


def divergence(mean: jax.Array, other: jax.Array, spread: Spread, slots: np.ndarray) -> jax.Array:
    """Return the KL divergence between two means `[..., C, A]`, that of each action `[..., C]`."""
    return _energy(mean - other, spread, slots)


def _energy(change: jax.Array, spread: Spread, slots: np.ndarray) -> jax.Array:
    """Return half of the squared z-scores `[..., C]` of changes `[..., C, A]`, given earlier."""
    change = jnp.where(slots, change, 0)
    earlier = jnp.pad(change[..., :-1, :], [(0, 0)] * (change.ndim - 2) + [(1, 0), (0, 0)])
    z = (change - spread.correlation * earlier) / spread.scales(change.shape[-2])
    return 0.5 * jnp.sum(jnp.square(z), axis=-1)
