"""Whether tasks pull the trained parameters in the same direction: cosines of their gradients."""

import functools
import itertools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.config import AuxiliaryConfig
from lorasp_jax.data.batches import Batch
from lorasp_jax.training.fixed_batches import Sample
from lorasp_jax.training.optim import auxiliary_weights
from lorasp_jax.training.rules import tower
from lorasp_jax.training.step import loss_fn

Pair = tuple[str, str]


def gradient_cosines(
    model: nnx.Module, samples: Mapping[str, Sample], key: jax.Array, batches: int
) -> dict[Pair, dict[str, float]]:
    """Return the cosine of the task losses' gradients for each pair of tasks.

    Each cosine is between two batches of equal size that are drawn independently, averaged over
    `batches` such pairs. Because gradients of finite batches are noisy, cosines are smaller than
    those of exact gradients: compare a pair with the pairs (task, task), which are the cosines of
    two batches of one task. At most two gradients are in memory at a time.

    Args:
        model: a backbone with trainable parameters.
        samples: see `fixed_batches.sampler`, by task.
        key: draws the batches, and the noise and flow times of their losses.
        batches: number of pairs of batches.

    Returns:
        Cosines by tower, and over all parameters as "all", for each pair of tasks in the order of
        `samples`, including each task with itself.
    """
    graphdef, adapters, frozen = adaptation.split(model)

    def gradient(task: str, key: jax.Array) -> Any:
        batch_key, loss_key = jax.random.split(key)
        return _gradient(graphdef, adapters, frozen, samples[task](batch_key), loss_key)

    cosines: dict[Pair, list[dict[str, float]]] = {}
    for batch_key in jax.random.split(key, batches):
        first_key, second_key = jax.random.split(batch_key)
        for pair in itertools.combinations_with_replacement(samples, 2):
            if pair[0] == pair[1]:  # the first pair of each task
                first = gradient(pair[0], first_key)
            second = gradient(pair[1], second_key)
            cosines.setdefault(pair, []).append(_cosines(first, second))
    return {
        pair: {tower: float(np.mean([row[tower] for row in rows])) for tower in rows[0]}
        for pair, rows in cosines.items()
    }


@functools.partial(jax.jit, static_argnums=0)
def _gradient(graphdef: Any, adapters: Any, frozen: Any, batch: Batch, key: jax.Array) -> Any:
    """Return the gradient of the task loss alone."""
    weights: Any = dict.fromkeys(auxiliary_weights(AuxiliaryConfig(), 1), 0.0)

    def task_loss(adapters: Any) -> jax.Array:
        return loss_fn(adapters, frozen, graphdef, batch, key, weights)[1]["task"]

    return jax.grad(task_loss)(adapters)


def _cosines(a: Any, b: Any) -> dict[str, float]:
    """Return the cosine of two gradients by tower and over all; 0 if one of them is zero."""
    sums: dict[str, np.ndarray] = jax.device_get(_products(a, b))
    sums["all"] = np.sum(list(sums.values()), axis=0)
    tiny = np.finfo(np.float64).tiny
    return {
        tower: float(dot / max(np.sqrt(float(aa) * float(bb)), tiny))
        for tower, (dot, aa, bb) in sums.items()
    }


@jax.jit
def _products(a: Any, b: Any) -> dict[str, jax.Array]:
    """Return a · b, a · a and b · b by tower, f32 `[3]`."""
    dot = functools.partial(jnp.vdot, precision="highest")  # a GPU would round to TF32
    products: dict[str, jax.Array] = {}
    flat = (jax.tree_util.tree_leaves_with_path(tree) for tree in (a, b))
    for (path, x), (_, y) in zip(*flat, strict=True):
        name = tower(path[0].key)
        three = jnp.stack([dot(x, y), dot(x, x), dot(y, y)])
        products[name] = products.get(name, jnp.zeros(3)) + three
    return products
