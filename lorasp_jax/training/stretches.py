"""Stretches of training steps in one call each, by where their data come from."""

import functools
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp

from envs.compilation import fast_cpu, messages
from lorasp_jax.data.batches import Raw, Steps, flatten, of_size
from lorasp_jax.data.pictures import loaded
from lorasp_jax.data.stream import Stream
from lorasp_jax.training.cost import flops, preflight
from lorasp_jax.training.cost.speed import Speed
from lorasp_jax.training.demonstrations import fresh_demonstrations
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.distributed import processes
from lorasp_jax.training.run import Run
from lorasp_jax.training.step import TrainState


class Stretches:
    """Stretches of steps, (state, key, count) -> state, metrics; each length is compiled once."""

    def __init__(self, jitted: Callable, frozen: Any, data: Steps | Raw, speed: Speed) -> None:
        self._jitted, self._frozen, self._data, self.speed = jitted, frozen, data, speed
        self._compiled: dict[int, Future] = {}

    def compile(self, state: TrainState, count: int) -> Future:
        """Begin to compile in a thread, unless that was done."""
        if count not in self._compiled:
            key = jax.random.key(0)

            def compiled() -> Any:
                with messages.said("the training step"):
                    lowered = self._jitted.lower(self._frozen, self._data, state, key, count)
                    return lowered.compile(compiler_options=fast_cpu.without_simulation())

            pool = ThreadPoolExecutor(1)
            self._compiled[count] = pool.submit(compiled)
            pool.shutdown(wait=False)
        return self._compiled[count]

    def __call__(self, state: TrainState, key: jax.Array, count: int) -> tuple[TrainState, Any]:
        """So many steps, of which each has its metrics."""
        run = self.compile(state, count).result()
        self.speed.begin()
        return run(self._frozen, self._data, state, key)


class Streamed(Stretches):
    """Stretches of steps whose batches come from files, one always on its way to the device."""

    def __init__(self, jitted: Callable, frozen: Any, batches: Iterator[Raw], speed: Speed) -> None:
        super().__init__(jitted, frozen, next(batches), speed)
        self._batches = batches

    def compile(self, state: TrainState, count: int) -> Future:  # noqa: ARG002
        """One step alone: each has a batch of its own."""
        return super().compile(state, 1)

    def __call__(self, state: TrainState, key: jax.Array, count: int) -> tuple[TrainState, Any]:
        """So many steps, while the batch after each is on its way."""
        found = []
        for _ in range(count):
            state, metrics = super().__call__(state, key, 1)
            with self.speed.waiting(metrics):
                self._data = next(self._batches)
            found.append(metrics)
        return state, jax.tree.map(lambda *values: jnp.concatenate(values), *found)


class Fresh(Stretches):
    """Stretches on demonstrations that are replaced now and then; those that train are generation
    0, 1, ... of as many steps each, and the next one is collected on the device meanwhile.

    What a generation holds is a function of the run's seed and its number alone, so a run that goes
    on in the midst of one collects it again.
    """

    def __init__(
        self, jitted: Callable, frozen: Any, run: Run, put: Callable, start: int, speed: Speed
    ) -> None:
        steps = loaded(run.steps)
        self._config, self._put, self._size = run.config, put, len(steps.end)
        last = run.config.optim.steps - 1
        self._generation = self._of(min(start, last))
        is_first = not self._generation or start > last  # or nothing trains any more
        first = put(steps) if is_first else self._made(self._generation)
        super().__init__(jitted, frozen, first, speed)
        self._prepare()

    def __call__(self, state: TrainState, key: jax.Array, count: int) -> tuple[TrainState, Any]:
        """So many steps, on the generation that is theirs."""
        if self._of(int(state.step)) > self._generation:
            self.speed.begin()
            with self.speed.waiting(state):
                self._data = self._coming.result()
            self._generation += 1
            self._prepare()
        return super().__call__(state, key, count)

    def _of(self, step: int) -> int:
        return step // self._config.data.fresh_every

    def _prepare(self) -> None:
        """Begin to collect the next generation in a thread, if there is to be one."""
        if self._of(self._config.optim.steps - 1) > self._generation:
            pool = ThreadPoolExecutor(1)
            self._coming = pool.submit(self._made, self._generation + 1)
            pool.shutdown(wait=False)

    def _made(self, generation: int) -> Steps:
        episodes = fresh_demonstrations(self._config, generation)
        return self._put(of_size(flatten(list(episodes.values())), self._size))


def stretches(
    run: Run, jitted: Callable, frozen: Any, mesh: jax.sharding.Mesh, start: int
) -> Stretches:
    """Stretches of steps from one on, on data from where the run has it."""
    if run.streams:
        return Streamed(jitted, frozen, _batches(run, mesh, start), _speed(run))
    put = lambda steps: processes.put(steps, meshes.replicated(mesh))  # noqa: E731
    if run.config.data.fresh_every:
        return Fresh(jitted, frozen, run, put, start, _speed(run))
    return Stretches(jitted, frozen, put(loaded(run.steps)), _speed(run))


def _batches(run: Run, mesh: jax.sharding.Mesh, start: int) -> Iterator[Raw]:
    """Batches of a dataset from a step on, split over the devices."""
    stream = Stream(
        run.steps,
        batch_size=run.config.optim.batch_size,
        chunk=run.policy.model.config.chunk,
        seed=run.config.seed,
        start=start,
        process=(jax.process_index(), jax.process_count()),
    )
    put = functools.partial(jax.make_array_from_process_local_data, meshes.batch_sharding(mesh))
    return (jax.tree.map(put, raw) for raw in stream)


def _speed(run: Run) -> Speed:
    """The run's clock; operations are counted where it is known how many there could be."""
    size = run.config.optim.batch_size
    if flops.peak() is None:
        return Speed(size, None)
    return Speed(size, preflight.operations(run.config, run.policy.model.config))
