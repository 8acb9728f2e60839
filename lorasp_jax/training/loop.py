"""The training loop: resume, train, log, save. Evaluation and reports are callbacks."""

import contextlib
import functools
import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.base.bars import bars
from lorasp_jax.config import Config, OptimConfig
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.batches import make_batches
from lorasp_jax.training.checkpoint import Checkpoints
from lorasp_jax.training.cost.speed import Speed
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.distributed import processes
from lorasp_jax.training.guard import summarize
from lorasp_jax.training.interrupt import deferred
from lorasp_jax.training.optim import make_optimizer
from lorasp_jax.training.program import Frozen, Program, jit_steps
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import MetricsLog
from lorasp_jax.training.step import TrainState, init_state


class RunError(ValueError):
    """The run cannot continue; the message states the reason and a remedy."""


def train(run: Run, callbacks: Sequence[Callback] = (), *, resume: bool = False) -> None:
    """Train the adapters of `run.policy`, then set `run.policy` to the trained policy.

    With `resume`, it continues from the newest checkpoint, if there is one.

    Raises:
        RunError: too many consecutive steps were skipped, or an update was non-finite.
        KeyboardInterrupt: a signal stopped the run; without a second one, the state is saved first.
    """
    shapes, initial, policy, make_program = _split(run)
    checkpoints = Checkpoints(run.folder, run.base_hash, run.console)
    if resume and checkpoints.has_any:
        run.policy = policy(shapes)  # the device may not hold another state beside the restored one
    restored = checkpoints.restore(shapes) if resume else None
    state = restored or initial()
    run.policy = policy(state)
    program = make_program(int(state.step))
    if restored is None:
        program.compile(state, _log_interval(run.config, int(state.step)))  # in the background
        _call(callbacks, run, "on_start")
    with training(run, checkpoints, callbacks):
        state = _loop(run, state, program, checkpoints, callbacks, policy)
    run.policy = policy(state)
    _call(callbacks, run, "on_end")


def trained(run: Run) -> Policy:
    """Train a run on one device, without files in its folder; return its policy.

    The run keeps the policy that it has. For errors see `train`.
    """
    with tempfile.TemporaryDirectory() as folder:
        learner = run.with_policy(run.policy, folder=Path(folder), devices=jax.devices()[:1])
        train(learner)
    return learner.policy


@contextlib.contextmanager
def training(run: Run, checkpoints: Checkpoints, callbacks: Sequence[Callback]) -> Iterator[None]:
    """Time the training in this block, tell callbacks why it cannot go on, close checkpoints."""
    try:
        with run.timed("train"):
            yield
    except RunError as error:
        for callback in callbacks:
            callback.on_stop(run, str(error))
        raise
    finally:
        checkpoints.close()


def _split(
    run: Run,
) -> tuple[TrainState, Callable[[], TrainState], Callable[..., Policy], Callable[..., Program]]:
    """Place the frozen part of the run on its devices.

    Returns:
        The shapes and shardings of its state, and functions: to the initial state, which has the
        adapters of `run.policy`; from a state to its policy; and from a step to the program that
        trains from there on.
    """
    graphdef, adapters, parameters = run.split()
    methods = adaptation.methods(run.policy.model).values()
    optimizer = make_optimizer(run.config.optim, methods, run.fixed)
    init = functools.partial(init_state, optimizer=optimizer, ema=run.config.optim.ema > 0)
    shapes = jax.eval_shape(init, adapters)
    mesh = meshes.make_mesh(run.config.fsdp, run.devices)
    shardings = meshes.shardings(shapes, mesh)
    shapes = jax.tree.map(meshes.with_sharding, shapes, shardings)
    processor = run.policy.processor
    frozen = Frozen(parameters, processor.shared(), adapters if run.objective else None)
    frozen = processes.device_put(frozen, meshes.shardings(frozen, mesh))

    def initial() -> TrainState:
        return processes.device_put(init(run.split()[1]), shardings)

    def policy(state: TrainState) -> Policy:
        return Policy(nnx.merge(graphdef, state.eval_adapters, frozen.parameters), processor)

    def make_program(start: int) -> Program:
        speed = Speed.of(run.config, run.policy.model.config)
        batches = make_batches(run, mesh, start, speed)
        return Program(jit_steps(run, graphdef, optimizer, shardings), frozen, batches, speed)

    return shapes, initial, policy, make_program


def _call(callbacks: Sequence[Callback], run: Run, hook: str) -> None:
    with _local_policy(run, hook):
        for callback in callbacks:
            getattr(callback, hook)(run)


def _call_on_log(
    callbacks: Sequence[Callback], run: Run, done: int, values: dict[str, float]
) -> dict[str, float]:
    """Return `values` with the scalars that callbacks add; a callback may evaluate the policy."""
    local_policy = _local_policy(run, f"evaluated at step {done}")
    needed = run.config.evaluates(done) or (run.held_out and run.config.validates(done))
    with local_policy if needed else contextlib.nullcontext():
        for callback in callbacks:
            values = values | (callback.on_log(run, done, values) or {})
    return values


@contextlib.contextmanager
def _local_policy(run: Run, name: str) -> Iterator[None]:
    """Keep the run's policy on a local device in this block, then wait for all processes.

    A policy that a callback puts in its place stays.
    """
    sharded, local = run.policy, processes.to_local(run.policy)
    run.policy = local
    yield
    run.policy = sharded if run.policy is local else run.policy
    processes.barrier(name)


def _log_interval(config: Config, done: int) -> int:
    """Return the number of steps until the next log entry or the end of training."""
    return min(config.log_every, config.optim.steps - done)


def _loop(
    run: Run,
    state: TrainState,
    program: Program,
    checkpoints: Checkpoints,
    callbacks: Sequence[Callback],
    policy: Callable[[TrainState], Policy],
) -> TrainState:
    """Run log intervals until the last step or a signal to stop."""
    config, key = run.config, RandomStream.TRAINING.key(run.config.seed)
    total, saved, stopped = config.optim.steps, int(state.step), False
    with (
        contextlib.closing(MetricsLog(run.folder, saved)) as log,
        deferred() as stop,
        bars(run.console, "samples", per_step=config.optim.batch_size) as progress,
    ):
        bar = progress.add_task(_first_text(saved, total), total=total, completed=saved)
        while (done := int(state.step)) < total and not stopped:
            count = _log_interval(config, done)
            state, metrics = program(state, key, done, count)
            rows, done = jax.device_get(metrics), done + count
            means = summarize(rows)
            run.layer_ranks = {name: mean for name, mean in means.items() if mean.ndim}
            values = {name: float(x.mean()) for name, x in means.items()} | program.speed.end(count)
            if error := _failure(config.optim, rows, values, done, saved):
                log.write(done, values)
                raise error
            text = f"training, loss {values.get('task', math.nan):.4f}"
            # The bar's own rate would include callbacks, such as measurements on held-out episodes.
            rate = values["speed/samples_per_second"]
            progress.update(bar, completed=done, description=text, rate=rate)
            run.policy = policy(state)
            values = _call_on_log(callbacks, run, done, values)
            log.write(done, values, run.layer_ranks)
            if done // config.checkpoint_every > saved // config.checkpoint_every:
                checkpoints.save(state)
                saved = done
            stopped = processes.any_process(stop.requested)
        checkpoints.save(state)
    if stopped:
        raise KeyboardInterrupt
    return state


def _first_text(saved: int, total: int) -> str:
    """Return the text of the bar before the first step."""
    if saved >= total:
        return "trained"
    return f"resumed at step {saved}, " * bool(saved) + "compiling train step ..."


def _failure(
    optim: OptimConfig, rows: dict[str, Any], values: dict[str, float], done: int, saved: int
) -> RunError | None:
    """Return an error if too many consecutive steps were skipped or an update was non-finite.

    `rows` are the metrics `[count, ...]` of the steps up to `done`, and `values` their means. The
    last checkpoint is at step `saved`.
    """
    remedy = f"nothing after step {saved} was saved: try a lower --optim.learning-rate"
    if (skipped := rows["in_a_row"].max()) >= optim.max_skipped:
        last = int(rows["in_a_row"].argmax())
        spike = f" or above {optim.spike:g} times its running mean" if optim.spike else ""
        return RunError(
            f"{skipped} consecutive steps were skipped because loss or gradient was non-finite"
            f"{spike} (step {done - len(rows['loss']) + last + 1}: loss {rows['loss'][last]:.3g}, "
            f"gradient norm {rows['grad_norm'][last]:.3g}); {remedy}"
        )
    if not math.isfinite(values.get("update_norm", 0.0)):
        return RunError(
            f"an update was non-finite by step {done} although all gradients were finite; {remedy}"
        )
    return None
