"""Models with random parameters, including norms and biases.

NumPy draws them, because JAX would compile a program for every shape.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from flax import nnx

from lorasp_jax.models.observation import Observation


def random_backbone(config: Any, seed: int = 0) -> Any:
    """Create a backbone with random parameters."""
    return with_random_parameters(lambda: config.create(nnx.Rngs(0)), seed)


def with_random_parameters(build: Callable[[], nnx.Module], seed: int = 0) -> Any:
    """Create the module that `build` returns, with random parameters."""
    rng = np.random.default_rng(seed)

    def draw(leaf: jax.ShapeDtypeStruct) -> jax.Array:
        fan_in = leaf.shape[-2] if len(leaf.shape) > 1 else 4
        return jax.device_put((rng.normal(size=leaf.shape) / fan_in**0.5).astype(leaf.dtype))

    graphdef, parameters = nnx.split(nnx.eval_shape(build))
    return nnx.merge(graphdef, jax.tree.map(draw, parameters))


def with_noise(tree: Any, scale: float, seed: int = 0) -> Any:
    """Add noise, as if after some training: at initialization half of the gradients vanish."""
    rng = np.random.default_rng(seed)
    noise = lambda x: scale * rng.normal(size=x.shape)  # noqa: E731
    return jax.tree.map(lambda x: jax.device_put((np.asarray(x) + noise(x)).astype(x.dtype)), tree)


def observation(config: Any, batch: int) -> Observation:
    """A random observation; the second example lacks a camera, and both have padding."""
    rng = np.random.default_rng(0)
    size, dim = config.image_size, config.action_dim
    image = rng.uniform(-1, 1, (batch, size, size, 3)).astype("f")
    tokens = rng.integers(config.vocabulary, size=(batch, config.max_tokens), dtype="i4")
    obs = Observation(
        images=dict.fromkeys(config.cameras, image),
        image_masks={"side": np.ones(batch, bool), "wrist": np.array([True, False])},
        tokens=tokens,
        token_mask=np.arange(config.max_tokens) < np.array([[3], [5]]),
        state=rng.normal(size=(batch, dim)).astype("f"),
    )
    return jax.device_put(obs)
