"""Models with random parameters, including norms and biases.

NumPy draws them, because JAX would compile a program for every shape.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.models.observation import Observation


def random_backbone(config: Any, seed: int = 0) -> Any:
    """Create a backbone with random parameters."""
    graphdef, parameters = _random_parameters(config, seed)
    return nnx.merge(graphdef, jax.tree.map(jnp.array, parameters))


@functools.lru_cache(maxsize=4)
def _random_parameters(config: Any, seed: int) -> Any:
    """Trace a constructor only once; in NumPy, as a training step may delete arrays of JAX."""
    model = with_random_parameters(lambda: config.create(nnx.Rngs(0)), seed)
    graphdef, parameters = nnx.split(model)
    return graphdef, jax.tree.map(np.asarray, parameters)


def with_random_parameters(build: Callable[[], nnx.Module], seed: int = 0) -> Any:
    """Create the module that `build` returns, with random parameters."""
    rng = np.random.default_rng(seed)

    def draw(leaf: jax.ShapeDtypeStruct) -> jax.Array:
        fan_in = leaf.shape[-2] if len(leaf.shape) > 1 else 4
        return jnp.asarray(rng.normal(size=leaf.shape) / fan_in**0.5, leaf.dtype)

    graphdef, parameters = nnx.split(nnx.eval_shape(build))
    return nnx.merge(graphdef, jax.tree.map(draw, parameters))


def with_noise(tree: Any, scale: float, seed: int = 0) -> Any:
    """Add noise, as if after some training: at initialization half of the gradients vanish."""
    rng = np.random.default_rng(seed)
    noise = lambda x: scale * rng.normal(size=x.shape)  # noqa: E731
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x) + noise(x), x.dtype), tree)


def observation(config: Any, batch: int) -> Observation:
    """A random observation; the second example lacks a camera, and both have padding."""
    keys = jax.random.split(jax.random.key(0), 3)
    shape = (batch, config.image_size, config.image_size, 3)
    return Observation(
        images={n: jax.random.uniform(keys[0], shape, minval=-1) for n in config.cameras},
        image_masks={"side": jnp.ones(batch, bool), "wrist": jnp.array([True, False])},
        tokens=jax.random.randint(keys[1], (batch, config.max_tokens), 0, config.vocabulary),
        token_mask=jnp.arange(config.max_tokens) < jnp.array([[3], [5]]),
        state=jax.random.normal(keys[2], (batch, config.action_dim)),
    )
