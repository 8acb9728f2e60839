"""Models with random parameters, norms and biases too.

NumPy draws them: JAX would compile a program for every shape.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.models.observation import Observation


def drawn(config: Any, seed: int = 0) -> Any:
    """A backbone of these sizes."""
    return filled(lambda: config.create(nnx.Rngs(0)), seed)


def filled(build: Callable[[], nnx.Module], seed: int = 0) -> Any:
    """What `build` makes, with other numbers in it."""
    rng = np.random.default_rng(seed)

    def draw(leaf: jax.ShapeDtypeStruct) -> jax.Array:
        fan_in = leaf.shape[-2] if len(leaf.shape) > 1 else 4
        return jnp.asarray(rng.normal(size=leaf.shape) / fan_in**0.5, leaf.dtype)

    graphdef, parameters = nnx.split(nnx.eval_shape(build))
    return nnx.merge(graphdef, jax.tree.map(draw, parameters))


def moved(tree: Any, size: float, seed: int = 0) -> Any:
    """Arrays as after some training: at their start, half of the gradients vanish."""
    rng = np.random.default_rng(seed)
    step = lambda x: size * rng.normal(size=x.shape)  # noqa: E731
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x) + step(x), x.dtype), tree)


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
