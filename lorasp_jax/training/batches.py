"""The batches of training steps: drawn from a dataset on the device, or streamed from disk."""

import functools
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

from lorasp_jax.data.batches import RawBatch, Steps, draw, fit_to_size, flatten, nbytes
from lorasp_jax.data.stream import Stream
from lorasp_jax.training.cost.speed import Speed
from lorasp_jax.training.demonstrations import fresh_demonstrations, in_thread
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.distributed import processes
from lorasp_jax.training.random_streams import StepKeys
from lorasp_jax.training.run import Run

MAX_BYTES = 2**28
"""Largest size of the batches of one call, unless a single batch is larger."""


class DrawnBatches:
    """The batches that calls of the training program take: random windows of a dataset."""

    def __init__(
        self,
        steps: Steps,
        mesh: jax.sharding.Mesh,
        batch_size: int,
        chunk: int,
        refresh: "Refresh | None" = None,
    ) -> None:
        """`steps` is on the mesh; `refresh` replaces it by others."""
        self._steps, self._refresh, self._running = steps, refresh, None
        self._sharding = meshes.batches_sharding(mesh)

        @functools.partial(jax.jit, static_argnames="size", out_shardings=self._sharding)
        def draw_batches(steps: Steps, key: jax.Array, first: jax.Array, size: int) -> RawBatch:
            keys = jax.vmap(lambda step: StepKeys.of(key, step).windows)(first + jnp.arange(size))
            one = functools.partial(draw, batch_size=batch_size, chunk=chunk)
            return jax.vmap(lambda key: one(key, steps))(keys)

        self._draw = draw_batches
        self._batch_bytes = nbytes(self.shapes(1))

    def call_size(self, count: int) -> int:
        """Return the largest divisor of `count` whose batches fit into `MAX_BYTES`, at least 1."""
        limit = max(MAX_BYTES // self._batch_bytes, 1)
        return max(size for size in range(1, min(limit, count) + 1) if count % size == 0)

    def shapes(self, size: int) -> Any:
        """Return a `RawBatch` of shapes and shardings."""
        key = jax.eval_shape(lambda: jax.random.key(0))
        step = jax.ShapeDtypeStruct((), jnp.int32)
        raw = jax.eval_shape(functools.partial(self._draw, size=size), self._steps, key, step)
        return jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=self._sharding), raw
        )

    def take(self, key: jax.Array, step: int, size: int) -> RawBatch:
        """Return the batches of `size` steps from `step` on, with a leading axis over steps.

        `key` is that of `RandomStream.TRAINING`.
        """
        if self._refresh is not None:
            self._steps = self._refresh(self._steps, step, self._running)
        return self._draw(self._steps, key, jnp.int32(step), size=size)

    def prepare(self, running: Any) -> None:
        """Remember the arrays that the device computes while the host prepares the next batches."""
        self._running = running


class Refresh:
    """Replaces the demonstrations every `every` steps by a new generation.

    Each generation (0, 1, ...) is used for that many steps; meanwhile the device collects the next.
    A generation depends only on its number and the run's seed, so a resumed run reproduces it.
    """

    def __init__(
        self, collect: Callable[[int], Steps], every: int, start: int, last: int, speed: Speed
    ) -> None:
        """Start to collect what follows the generation of step `start`; `last` is the last step.

        `collect` returns a generation on the device; all generations have the same shapes.
        """
        self._collect, self._every, self._last, self._speed = collect, every, last, speed
        self._generation = start // every
        self._collect_next()

    def __call__(self, steps: Steps, step: int, running: Any) -> Steps:
        """Return the generation of `step`, which follows the one of `steps` or is the same."""
        if step // self._every > self._generation:
            with self._speed.waiting(running):
                steps = self._next.result()
            self._generation += 1
            self._collect_next()
        return steps

    def _collect_next(self) -> None:
        """Start collecting the next generation in a thread, if a step will use it."""
        if self._last // self._every > self._generation:
            self._next = in_thread(self._collect, self._generation + 1)


class StreamedBatches:
    """Batches that are read from disk, one per call; the next one is already on the device."""

    def __init__(self, run: Run, mesh: jax.sharding.Mesh, start: int, speed: Speed) -> None:
        """Read the batch of step `start`, sharded over the mesh; its leading axis has length 1."""
        self._stream = Stream(
            run.steps,
            batch_size=run.config.optim.batch_size,
            chunk=run.policy.model.config.chunk,
            seed=run.config.seed,
            start=start,
            process=(jax.process_index(), jax.process_count()),
        )
        self._sharding, self._speed = meshes.batches_sharding(mesh), speed
        self._batch = self._next()

    def _next(self) -> RawBatch:
        put = functools.partial(jax.make_array_from_process_local_data, self._sharding)
        return jax.tree.map(lambda x: put(x[None]), next(self._stream))

    def call_size(self, count: int) -> int:  # noqa: ARG002
        """Return 1."""
        return 1

    def shapes(self, size: int) -> RawBatch:  # noqa: ARG002
        """Return the batch that was read."""
        return self._batch

    def take(self, key: jax.Array, step: int, size: int) -> RawBatch:  # noqa: ARG002
        """Return the batch that was read; the order of batches is that of the iterator."""
        return self._batch

    def prepare(self, running: Any) -> None:
        """Read the next batch."""
        with self._speed.waiting(running):
            self._batch = self._next()


Batches: TypeAlias = DrawnBatches | StreamedBatches


def make_batches(run: Run, mesh: jax.sharding.Mesh, start: int, speed: Speed) -> Batches:
    """Return the batches of the run's data from step `start` on."""
    if run.streams:
        return StreamedBatches(run, mesh, start, speed)

    def generation(number: int) -> Steps:
        steps = run.steps
        if number:
            episodes = fresh_demonstrations(run.config, number)
            steps = fit_to_size(flatten(list(episodes.values())), len(steps.end))
        return processes.device_put(steps, meshes.replicated(mesh))

    optim, every = run.config.optim, run.config.data.fresh_every
    # After the last step nothing trains: use generation 0, which exists already.
    first = start // every if every and start < optim.steps else 0
    steps, last = generation(first), optim.steps - 1
    refresh = Refresh(generation, every, min(start, last), last, speed) if every else None
    return DrawnBatches(steps, mesh, optim.batch_size, run.policy.model.config.chunk, refresh)
