"""Models with random parameters, norms and biases too, drawn faster than by their own `create`."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.models.observation import Observation


def drawn(config: Any) -> Any:
    """A model of these sizes."""
    rng = np.random.default_rng(0)

    def draw(leaf: jax.ShapeDtypeStruct) -> jax.Array:
        fan_in = leaf.shape[-2] if len(leaf.shape) > 1 else 4
        return jnp.asarray(rng.normal(size=leaf.shape) / fan_in**0.5, leaf.dtype)

    graphdef, parameters = nnx.split(nnx.eval_shape(lambda: config.create(nnx.Rngs(0))))
    return nnx.merge(graphdef, jax.tree.map(draw, parameters))


def observation(config: Any, batch: int) -> Observation:
    """What a policy of these sizes sees; the second example lacks a camera, both have padding."""
    keys = jax.random.split(jax.random.key(0), 3)
    shape = (batch, config.image_size, config.image_size, 3)
    return Observation(
        images={n: jax.random.uniform(keys[0], shape, minval=-1) for n in config.cameras},
        image_masks={"side": jnp.ones(batch, bool), "wrist": jnp.array([True, False])},
        tokens=jax.random.randint(keys[1], (batch, config.max_tokens), 0, config.vocabulary),
        token_mask=jnp.arange(config.max_tokens) < jnp.array([[3], [5]]),
        state=jax.random.normal(keys[2], (batch, config.action_dim)),
    )
