"""Models with random parameters, norms and biases too, drawn faster than by their own `create`."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx


def drawn(config: Any) -> Any:
    """A model of these sizes."""
    rng = np.random.default_rng(0)

    def draw(leaf: jax.ShapeDtypeStruct) -> jax.Array:
        fan_in = leaf.shape[-2] if len(leaf.shape) > 1 else 4
        return jnp.asarray(rng.normal(size=leaf.shape) / fan_in**0.5, leaf.dtype)

    graphdef, parameters = nnx.split(nnx.eval_shape(lambda: config.create(nnx.Rngs(0))))
    return nnx.merge(graphdef, jax.tree.map(draw, parameters))
