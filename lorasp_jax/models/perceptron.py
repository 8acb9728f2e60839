"""A multilayer perceptron that normalizes its inputs, such as the simulator's full state."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

_LIMIT = 5.0
"""Normalized states are clipped to this magnitude."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Network:
    """Layers with tanh between them.

    Attributes:
        layers: weights and biases; those of the last layer may have several output axes.
        mean, std: `[D]`, which normalize states; zeros until they are measured.
    """

    layers: list[tuple[jax.Array, jax.Array]]
    mean: jax.Array
    std: jax.Array

    @classmethod
    def init(cls, key: jax.Array, widths: Sequence[int], output: Sequence[int]) -> "Network":
        """Create a network of states `[D]` that returns about 0, an array of shape `output`.

        `widths` are D and the hidden ones.
        """
        sizes = *widths, int(np.prod(output))
        scales = *[1.4] * (len(widths) - 1), 0.01  # of tanh; and small at the end
        keys = jax.random.split(key, len(widths))
        layers = [
            (jax.nn.initializers.orthogonal(scale)(k, (i, o)), jnp.zeros(o))
            for k, scale, i, o in zip(keys, scales, sizes[:-1], sizes[1:], strict=True)
        ]
        weight, bias = layers[-1]
        layers[-1] = weight.reshape(-1, *output), bias.reshape(*output)
        return cls(layers, jnp.zeros(widths[0]), jnp.zeros(widths[0]))

    def __call__(self, state: jax.Array) -> jax.Array:
        """Map states `[..., D]` to `[..., *output]`."""
        x = jnp.clip((finite(state) - self.mean) / (self.std + 1e-3), -_LIMIT, _LIMIT)
        for weight, bias in self.layers[:-1]:
            x = jnp.tanh(x @ weight + bias)
        weight, bias = self.layers[-1]
        return jnp.tensordot(x, weight, 1) + bias


def finite(state: jax.Array) -> jax.Array:
    """Replace what is not a number or infinite by 0."""
    return jnp.nan_to_num(state, posinf=0.0, neginf=0.0)


def moments(states: jax.Array, mask: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return mean and standard deviation `[D]` of the states `[..., D]` where a mask is set."""
    states, axes = finite(states), tuple(range(mask.ndim))
    mean = jnp.mean(states, axes, where=mask[..., None])
    return mean, jnp.sqrt(jnp.mean(jnp.square(states - mean), axes, where=mask[..., None]))
