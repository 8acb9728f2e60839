"""The batches of several training steps in one pytree, which the training program takes."""

import functools
from collections.abc import Iterator
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from lorasp_jax.data.batches import Raw, Steps, draw
from lorasp_jax.training.cost.preflight import nbytes
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.random_streams import StepKeys

MAX_BYTES = 2**28
"""Largest size of the batches of one call, unless a single batch is larger."""


class Windows(Protocol):
    """A source of batches."""

    def call_size(self, count: int) -> int:
        """Return the number of steps per call, a divisor of `count`."""
        ...

    def shapes(self, size: int) -> Any:
        """Return a `Raw` of arrays, or of their shapes and shardings, as calls return them."""
        ...

    def __call__(self, key: jax.Array, step: jax.Array, size: int) -> Raw:
        """Return the batches of `size` steps from `step` on, with a leading axis over steps.

        Args:
            key: key of `RandomStream.TRAINING`.
            step: `[]` int32.
            size: number of steps.
        """
        ...


class DrawnWindows:
    """Random windows of a dataset on the device."""

    def __init__(self, steps: Steps, mesh: jax.sharding.Mesh, batch_size: int, chunk: int) -> None:
        """Store the arguments; `steps` is on the mesh, and may be replaced by others like it."""
        self.steps = steps
        self._sharding = meshes.batches_sharding(mesh)
        sizes = {"batch_size": batch_size, "chunk": chunk}
        self._draw = jax.jit(
            functools.partial(_draw, **sizes),
            static_argnames="size",
            out_shardings=self._sharding,
        )
        self._batch_bytes = nbytes(self.shapes(1))

    def call_size(self, count: int) -> int:
        """Return the largest divisor of `count` whose batches fit into `MAX_BYTES`, at least 1."""
        limit = max(MAX_BYTES // self._batch_bytes, 1)
        return max(size for size in range(1, min(limit, count) + 1) if count % size == 0)

    def shapes(self, size: int) -> Any:
        """Return a `Raw` of shapes and shardings."""
        key = jax.eval_shape(lambda: jax.random.key(0))
        step = jax.ShapeDtypeStruct((), jnp.int32)
        raw = jax.eval_shape(functools.partial(self._draw, size=size), self.steps, key, step)
        return jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=self._sharding), raw
        )

    def __call__(self, key: jax.Array, step: jax.Array, size: int) -> Raw:
        """Draw the batches; see `Windows`."""
        return self._draw(self.steps, key, step, size=size)


class StreamedWindows:
    """Batches that are read from disk, one per call."""

    def __init__(self, batches: Iterator[Raw]) -> None:
        """Read the first batch; batches have a leading axis of length 1."""
        self._batches = batches
        self.read_next()

    def read_next(self) -> None:
        """Read the batch for the next call."""
        self._batch = next(self._batches)

    def call_size(self, count: int) -> int:  # noqa: ARG002
        """Return 1."""
        return 1

    def shapes(self, size: int) -> Raw:  # noqa: ARG002
        """Return the batch that was read."""
        return self._batch

    def __call__(self, key: jax.Array, step: jax.Array, size: int) -> Raw:  # noqa: ARG002
        """Return the batch that was read; the order of batches is that of the iterator."""
        return self._batch


def _draw(
    steps: Steps, key: jax.Array, first: jax.Array, *, size: int, batch_size: int, chunk: int
) -> Raw:
    keys = jax.vmap(lambda step: StepKeys.of(key, step).windows)(first + jnp.arange(size))
    return jax.vmap(lambda key: draw(key, steps, batch_size=batch_size, chunk=chunk))(keys)
