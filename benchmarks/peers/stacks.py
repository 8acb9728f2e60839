"""A stack of dense layers in Flax NNX and the gradient of its adapters, for qwix and this project.

It is also imported in qwix's environment, so it needs only JAX and Flax.
"""

import time
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from benchmarks.peers import worker, workloads
from benchmarks.peers.worker import Job, Row


class Stack(nnx.Module):
    """A sequence of dense layers, not scanned."""

    def __init__(self, depth: int, width: int, dtype: Any = jnp.bfloat16) -> None:
        """Initialize the weights."""
        options = {"dtype": dtype, "param_dtype": dtype, "rngs": nnx.Rngs(0)}
        self.layers = nnx.List([nnx.Linear(width, width, **options) for _ in range(depth)])

    def __call__(self, x: jax.Array) -> jax.Array:
        """Apply all layers; x and the result are [T, D]."""
        for layer in self.layers:
            x = nnx.relu(layer(x))
        return x


def inputs(sizes: workloads.Stack) -> jax.Array:
    """Return x `[T, D]` bf16."""
    return jax.random.normal(jax.random.key(0), (sizes.tokens, sizes.width), jnp.bfloat16)


def rows(model: nnx.Module, x: jax.Array, job: Job) -> Iterator[Row]:
    """Measure the first compilation and the gradient of the adapters, `nnx.LoRAParam`."""
    graph, trained, frozen = nnx.split(model, nnx.LoRAParam, ...)

    def loss(trained: Any, frozen: Any, x: jax.Array) -> jax.Array:
        merged: Any = nnx.merge(graph, trained, frozen)
        return jnp.square(merged(x).astype(jnp.float32)).mean()

    start = time.perf_counter()
    compiled = jax.jit(jax.value_and_grad(loss)).lower(trained, frozen, x).compile()
    seconds = time.perf_counter() - start
    yield {"item": "compilation", "median_s": seconds, "min_s": seconds, "max_s": seconds}
    row = worker.timed("gradient", lambda: compiled(trained, frozen, x), jax.block_until_ready, job)
    count = sum(leaf.size for leaf in jax.tree.leaves(trained))
    yield row | {"trainable": count, "gib": worker.jax_peak_gib()}
