"""The training program: many steps in one compiled call."""

import dataclasses
import functools
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.base import messages
from lorasp_jax.data.augmentation import augment
from lorasp_jax.data.batches import RawBatch, encode
from lorasp_jax.policies.processor import Processor
from lorasp_jax.training import compilation
from lorasp_jax.training.batches import Batches
from lorasp_jax.training.cost.speed import Speed
from lorasp_jax.training.demonstrations import in_thread
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.optim import auxiliary_weights, flow_times
from lorasp_jax.training.random_streams import StepKeys
from lorasp_jax.training.run import Run
from lorasp_jax.training.step import TrainState, train_step


class Frozen(NamedTuple):
    """What training does not change.

    Attributes:
        parameters: frozen parameters of the model.
        processor: normalizes the batches; an input of the training program and not a part of it, so
            that runs on other demonstrations have the same program.
        start: the adapters at the start, if the run has an `objective`.
    """

    parameters: Any
    processor: Processor
    start: Any = None


def jit_steps(run: Run, graphdef: Any, optimizer: Any, shardings: TrainState) -> Callable:
    """Return the jitted scan over steps: (frozen, batches, state, key) -> state, metrics.

    `frozen` is a `Frozen`, `batches` a `RawBatch`; the batches and the metrics have a leading axis
    over steps. `shardings` are those of the state, from `meshes.shardings`. If a run calls this
    again with equal inputs, it gets the same program, which JAX has traced already.
    """
    optim, mesh = run.config.optim, shardings.step.mesh
    step = functools.partial(
        train_step,
        graphdef=graphdef,
        optimizer=optimizer,
        weights=auxiliary_weights(run.config.auxiliary, optim.steps),
        parts=optim.accumulate,
        ema=optim.ema,
        spike=optim.spike,
        times=flow_times(optim),
    )

    def body(state: TrainState, raw: RawBatch, frozen: Frozen, key: jax.Array) -> Any:
        keys = StepKeys.of(key, state.step)
        noise = optim.state_noise
        batch = encode(keys.state_noise, raw, frozen.processor, state_noise=noise)
        if recipe := run.augmentation:
            images = augment(keys.images, batch.observation, frozen.processor, recipe)
            batch = dataclasses.replace(batch, observation=images)
        batch = jax.lax.with_sharding_constraint(batch, meshes.batch_sharding(mesh))
        objective = None
        if learned := run.objective:
            start = nnx.merge(graphdef, frozen.start, frozen.parameters)
            objective = lambda model, *drawn: learned(model, start, *drawn)  # noqa: E731
        return step(state, frozen.parameters, batch, keys.loss, objective=objective)

    # Keep the state's sharding: the compiled program accepts no other as its input.
    @functools.partial(
        jax.jit,
        donate_argnames="state",
        out_shardings=(shardings, meshes.replicated(mesh)),
        compiler_options=compilation.step_options(mesh.size),
    )
    def scan(frozen: Frozen, batches: RawBatch, state: TrainState, key: jax.Array) -> Any:
        return jax.lax.scan(lambda state, raw: body(state, raw, frozen, key), state, batches)

    inputs = optim, run.config.auxiliary, run.augmentation, run.objective, graphdef
    return run.programs.setdefault((*inputs, *jax.tree.leaves(shardings)), scan)


class Program:
    """The compiled training program, (state, key, done, count) -> state, metrics.

    It takes batches, not the dataset: it is the same for datasets of any size.
    """

    def __init__(self, jitted: Callable, frozen: Frozen, batches: Batches, speed: Speed) -> None:
        """`jitted` is from `jit_steps`; nothing is compiled yet."""
        self._jitted, self._frozen, self._batches = jitted, frozen, batches
        self.speed: Speed = speed
        self._compiled: dict[int, Future[Any]] = {}

    def compile(self, state: TrainState, count: int) -> Future[Any]:
        """Start compiling the calls that run `count` steps in a background thread, once."""
        size = self._batches.call_size(count)
        if size not in self._compiled:
            self._compiled[size] = in_thread(self._compile, state, size)
        return self._compiled[size]

    def _compile(self, state: TrainState, size: int) -> Any:
        key = jax.random.key(0)
        with messages.announce("the training step"):
            lowered = self._jitted.lower(self._frozen, self._batches.shapes(size), state, key)
            return lowered.compile()

    def __call__(
        self, state: TrainState, key: jax.Array, done: int, count: int
    ) -> tuple[TrainState, Any]:
        """Run `count` steps after the `done` ones; metrics have a leading axis over steps."""
        compiled, size = self.compile(state, count).result(), self._batches.call_size(count)
        self.speed.begin()
        rows = []
        for step in range(done, done + count, size):
            batches = self._batches.take(key, step, size)
            state, metrics = compiled(self._frozen, batches, state, key)
            self._batches.prepare(metrics)
            rows.append(metrics)
        return state, jax.tree.map(lambda *values: jnp.concatenate(values), *rows)
