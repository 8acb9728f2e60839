"""Updates with known singular values."""

import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters import paths
from lorasp_jax.dense import AdaptedLayer, AdapterParam
from tests.models.random_models import with_noise


def matrix(shape, singular_values, seed):
    """A matrix with the given singular values that are not zero."""
    rng, n = np.random.default_rng(seed), len(singular_values)
    left, right = (np.linalg.qr(rng.normal(size=(size, n)))[0] for size in shape)
    return (left * singular_values @ right.T).astype(np.float32)


def set_kernel(layer, kernel):
    layer.kernel.set_value(jnp.asarray(kernel, jnp.float32))


def add_noise(model, scale=0.5):
    """Move all adapters away from their initialization."""
    for i, location in enumerate(paths.locate(nnx.List([model]), AdaptedLayer)):
        if location.child.adapter is not None:
            noisy = with_noise(location.child.adapter.get_value(), scale, seed=i)
            location.child.adapter = AdapterParam(noisy)
    return model
