"""Run several training steps per call.

The data is on the device, streamed from disk, or replaced by newly collected demonstrations.
"""

import functools
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

import jax
import jax.numpy as jnp

from envs.compilation import messages
from envs.datasets.episodes import Episodes
from lorasp_jax.config import Config
from lorasp_jax.data.batches import Raw, Steps, fit_to_size, flatten
from lorasp_jax.data.stream import Stream
from lorasp_jax.training.cost import flops, preflight
from lorasp_jax.training.cost.speed import Speed
from lorasp_jax.training.demonstrations import in_thread
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.distributed import processes
from lorasp_jax.training.run import Run
from lorasp_jax.training.step import TrainState
from lorasp_jax.training.windows import DrawnWindows, StreamedWindows, Windows

Collect = Callable[[Config, int], dict[str, Episodes]]
"""Collects demonstrations per task for generation 1, 2, ... (see `fresh_demonstrations`)."""


class Stepper:
    """Runs steps, (state, key, count) -> state, metrics.

    The training program takes batches, not the dataset: it is the same for datasets of any size.
    """

    def __init__(self, jitted: Callable, frozen: Any, windows: Windows, speed: Speed) -> None:
        """Store the arguments; nothing is compiled yet.

        Args:
            jitted: step function from `loop.jit_steps`.
            frozen: a `loop.Frozen`, on the mesh.
            windows: source of batches.
            speed: meter of training speed.
        """
        self._jitted, self._frozen, self._windows = jitted, frozen, windows
        self.speed: Speed = speed
        self._compiled: dict[int, Future[Any]] = {}

    def compile(self, state: TrainState, count: int) -> Future[Any]:
        """Start compiling the calls that run `count` steps in a background thread, once."""
        size = self._windows.call_size(count)
        if size not in self._compiled:
            self._compiled[size] = in_thread(self._compile, state, size)
        return self._compiled[size]

    def _compile(self, state: TrainState, size: int) -> Any:
        key = jax.random.key(0)
        with messages.announce("the training step"):
            lowered = self._jitted.lower(self._frozen, self._windows.shapes(size), state, key)
            return lowered.compile()

    def __call__(self, state: TrainState, key: jax.Array, count: int) -> tuple[TrainState, Any]:
        """Run `count` steps; metrics have a leading axis over steps."""
        compiled, size = self.compile(state, count).result(), self._windows.call_size(count)
        self.speed.begin()
        rows = []
        for _ in range(count // size):
            batches = self._windows(key, state.step, size)
            state, metrics = compiled(self._frozen, batches, state, key)
            self._called(metrics)
            rows.append(metrics)
        return state, jax.tree.map(lambda *values: jnp.concatenate(values), *rows)

    def _called(self, metrics: Any) -> None:
        """Do what is due while the device runs a call that will return `metrics`."""


class StreamingStepper(Stepper):
    """Runs steps on batches read from disk; the next batch is prefetched to the device."""

    def __init__(self, jitted: Callable, frozen: Any, batches: Iterator[Raw], speed: Speed) -> None:
        """Read the first batch; for the other arguments see `Stepper`."""
        self._streamed = StreamedWindows(batches)
        super().__init__(jitted, frozen, self._streamed, speed)

    def _called(self, metrics: Any) -> None:
        with self.speed.waiting(metrics):
            self._streamed.read_next()


class RefreshingStepper(Stepper):
    """Runs steps on demonstrations that are replaced every `data.fresh_every` steps.

    Each generation (0, 1, ...) is used for that many steps; meanwhile the device collects the next.
    A generation depends only on its number and the run's seed, so a resumed run reproduces it.
    """

    def __init__(
        self,
        jitted: Callable,
        frozen: Any,
        windows: Callable[[Steps], DrawnWindows],
        speed: Speed,
        config: Config,
        collect: Callable[[int], Steps],
        start: int,
    ) -> None:
        """Collect the generation of step `start` and start collecting the next one.

        `windows` draws from a generation. `collect` returns a generation on the device; all
        generations have the same shapes.
        """
        self._every, self._last = config.data.fresh_every, config.optim.steps - 1
        self._collect = collect
        self._generation = self._generation_of(min(start, self._last))
        # After the last step nothing trains: use generation 0, which exists already.
        first = self._generation if start <= self._last else 0
        self._drawn = windows(collect(first))
        super().__init__(jitted, frozen, self._drawn, speed)
        self._collect_next()

    def __call__(self, state: TrainState, key: jax.Array, count: int) -> tuple[TrainState, Any]:
        """Run `count` steps on the generation of `state.step`."""
        if self._generation_of(int(state.step)) > self._generation:
            self.speed.begin()
            with self.speed.waiting(state):
                self._drawn.steps = self._next.result()
            self._generation += 1
            self._collect_next()
        return super().__call__(state, key, count)

    def _generation_of(self, step: int) -> int:
        return step // self._every

    def _collect_next(self) -> None:
        """Start collecting the next generation in a thread, if a step will use it."""
        if self._generation_of(self._last) > self._generation:
            self._next = in_thread(self._collect, self._generation + 1)


def make_stepper(
    run: Run,
    jitted: Callable,
    frozen: Any,
    mesh: jax.sharding.Mesh,
    start: int,
    collect: Collect,
) -> Stepper:
    """Create the stepper that suits the run's data.

    `start` is the index of the first step. `collect` is called only if `data.fresh_every` is set.
    For the other arguments see `Stepper`.
    """
    speed = _speed(run)
    if run.streams:
        return StreamingStepper(jitted, frozen, _batches(run, mesh, start), speed)

    def generation(number: int) -> Steps:
        steps = run.steps
        if number:
            episodes = collect(run.config, number)
            steps = fit_to_size(flatten(list(episodes.values())), len(steps.end))
        return processes.device_put(steps, meshes.replicated(mesh))

    sizes = {
        "batch_size": run.config.optim.batch_size,
        "chunk": run.policy.model.config.chunk,
    }
    windows = functools.partial(DrawnWindows, mesh=mesh, **sizes)
    if run.config.data.fresh_every:
        return RefreshingStepper(jitted, frozen, windows, speed, run.config, generation, start)
    return Stepper(jitted, frozen, windows(generation(0)), speed)


def _batches(run: Run, mesh: jax.sharding.Mesh, start: int) -> Iterator[Raw]:
    """Return the dataset's batches from step `start` on, sharded over the devices.

    They have a leading axis of length 1, see `StreamedWindows`.
    """
    stream = Stream(
        run.steps,
        batch_size=run.config.optim.batch_size,
        chunk=run.policy.model.config.chunk,
        seed=run.config.seed,
        start=start,
        process=(jax.process_index(), jax.process_count()),
    )
    sharding = meshes.batches_sharding(mesh)
    put = lambda x: jax.make_array_from_process_local_data(sharding, x[None])  # noqa: E731
    return (jax.tree.map(put, raw) for raw in stream)


def _speed(run: Run) -> Speed:
    """Create the speed meter; FLOPs are counted only if the device's peak FLOP/s is known."""
    size = run.config.optim.batch_size
    if flops.peak() is None:
        return Speed(size, None)
    return Speed(size, preflight.step_flops(run.config, run.policy.model.config))
