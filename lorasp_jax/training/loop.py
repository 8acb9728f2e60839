"""The training run: build, resume, train, save. Knows neither evaluation nor report."""

import contextlib
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
from flax import nnx

from lorasp_jax.adapters import adaptation
from lorasp_jax.config import Config, OptimConfig
from lorasp_jax.data.batches import Raw, Steps, encode, sample_batch
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.checkpoint import Checkpoints
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.distributed import processes
from lorasp_jax.training.guard import summarise
from lorasp_jax.training.interrupt import deferred
from lorasp_jax.training.optim import auxiliary_weights, make_optimizer
from lorasp_jax.training.run import Callback, Run, bars
from lorasp_jax.training.run_folder import MetricsLog
from lorasp_jax.training.step import TrainState, init_state, train_step
from lorasp_jax.training.stretches import Stretches, stretches


class RunError(ValueError):
    """The run cannot go on; the message says why and what to do, in one sentence."""


def train(run: Run, callbacks: Sequence[Callback] = (), *, resume: bool = False) -> None:
    """Train the adapters of `run.policy` and leave the trained policy there.

    Raises:
        RunError: too many steps in a row were skipped; the last checkpoint before stays.
        KeyboardInterrupt: a signal asked to stop; the state is saved.
    """
    methods = adaptation.methods(run.policy.model).values()
    optimizer = make_optimizer(run.config.optim, methods)
    mesh = meshes.make_mesh(run.config.fsdp)
    graphdef, adapters, frozen = adaptation.split(run.policy.model)
    state = init_state(adapters, optimizer, ema=run.config.optim.ema > 0)
    placed = meshes.shardings(state, mesh)
    state = processes.put(state, placed)
    frozen = processes.put(frozen, meshes.shardings(frozen, mesh))
    processor = run.policy.processor
    policy = lambda state: Policy(nnx.merge(graphdef, state.best, frozen), processor)  # noqa: E731
    run.policy = policy(state)
    checkpoints = Checkpoints(run.folder, run.base_hash, run.console)
    restored = checkpoints.restore(state) if resume else None
    state = restored or state
    jitted = jit_stretch(run, graphdef, optimizer, placed)
    many = stretches(run, jitted, frozen, mesh, int(state.step))
    if restored is None:
        many.compile(state, _stretch(run.config, int(state.step)))  # beside what the callbacks do
        _tell(callbacks, run, "on_start")
    try:
        with run.timed("train"):
            state = _loop(run, state, many, checkpoints, callbacks, policy)
    except RunError as error:
        for callback in callbacks:
            callback.on_stop(run, str(error))
        processes.wait("stopped")  # or the first one might be ended before it has told
        raise
    finally:
        checkpoints.close()
    run.policy = policy(state)
    _tell(callbacks, run, "on_end")


def _tell(callbacks: Sequence[Callback], run: Run, hook: str) -> None:
    """Call one hook of all callbacks."""
    with _own_policy(run, hook):
        for callback in callbacks:
            getattr(callback, hook)(run)


def _log(
    callbacks: Sequence[Callback], run: Run, done: int, values: dict[str, float]
) -> dict[str, float]:
    """What is known after a stretch, with what callbacks add to it, which may evaluate."""
    evaluated = _own_policy(run, f"evaluated at step {done}")
    with evaluated if run.config.evaluates(done) else contextlib.nullcontext():
        for callback in callbacks:
            values = values | (callback.on_log(run, done, values) or {})
    return values


@contextlib.contextmanager
def _own_policy(run: Run, name: str) -> Iterator[None]:
    """In this block the run's policy is on this process's own device; at its end all wait."""
    everywhere, run.policy = run.policy, processes.own(run.policy)
    yield
    run.policy = everywhere
    processes.wait(name)


def jit_stretch(run: Run, graphdef: Any, optimizer: Any, placed: TrainState) -> Callable:
    """The jitted stretch of steps: (frozen, data, state, key, count) -> state, metrics of each.

    Data are all steps, or one raw batch. The state lies as `placed` says, its `meshes.shardings`.
    """
    optim, processor = run.config.optim, run.policy.processor
    chunk = run.policy.model.config.chunk
    weights = auxiliary_weights(run.config.auxiliary, optim.steps)
    mesh = placed.step.mesh
    sharding = meshes.batch_sharding(mesh)

    step = functools.partial(
        train_step,
        graphdef=graphdef,
        optimizer=optimizer,
        weights=weights,
        parts=optim.accumulate,
        ema=optim.ema,
        spike=optim.spike,
    )
    draw = functools.partial(sample_batch, batch_size=optim.batch_size, chunk=chunk)

    def one(state: TrainState, frozen: Any, data: Steps | Raw, key: jax.Array) -> Any:
        batch_key, loss_key = jax.random.split(jax.random.fold_in(key, state.step))
        make: Any = encode if isinstance(data, Raw) else draw
        batch = make(batch_key, data, processor, state_noise=optim.state_noise)
        batch = jax.lax.with_sharding_constraint(batch, sharding)
        return step(state, frozen, batch, loss_key)

    # The state comes back placed as it went in, so that nothing compiles a second time.
    @functools.partial(
        jax.jit,
        static_argnames="count",
        donate_argnames="state",
        out_shardings=(placed, meshes.replicated(mesh)),
    )
    def many(frozen: Any, data: Steps | Raw, state: TrainState, key: jax.Array, count: int) -> Any:
        return jax.lax.scan(lambda state, _: one(state, frozen, data, key), state, length=count)

    return many


def _stretch(config: Config, done: int) -> int:
    """Steps until the next log line or the end."""
    return min(config.log_every, config.optim.steps - done)


def _loop(
    run: Run,
    state: TrainState,
    many: Stretches,
    checkpoints: Checkpoints,
    callbacks: Sequence[Callback],
    policy: Callable[[TrainState], Policy],
) -> TrainState:
    """Stretch after stretch until the last step or a signal."""
    config = run.config
    key = jax.random.fold_in(jax.random.key(config.seed), 2)
    total, saved = config.optim.steps, int(state.step)
    with (
        contextlib.closing(MetricsLog(run.folder, int(state.step))) as log,
        deferred() as stop,
        bars(run.console, "samples", per_step=config.optim.batch_size) as progress,
    ):
        bar = progress.add_task("compiling train step ...", total=total, completed=saved)
        stopped = False
        while (done := int(state.step)) < total and not stopped:
            count = _stretch(config, done)
            state, metrics = many(state, key, count)
            rows = jax.device_get(metrics)
            found, done = summarise(rows), done + count
            values = {name: float(value.mean()) for name, value in found.items()}
            values |= many.speed.end(count)
            if reason := _stopping(config.optim, rows, values, done):
                log.write(done, values)
                raise RunError(
                    f"{reason}: nothing after step {saved} was saved; try a lower "
                    "--optim.learning-rate"
                )
            loss = values.get("task", math.nan)
            progress.update(bar, completed=done, description=f"training, loss {loss:.4f}")
            run.policy = policy(state)
            values = _log(callbacks, run, done, values)
            log.write(done, values, {name: x for name, x in found.items() if x.ndim})
            if done // config.checkpoint_every > saved // config.checkpoint_every:
                checkpoints.save(state)
                saved = done
            stopped = processes.anywhere(stop.requested)
        checkpoints.save(state)
    if stopped:
        raise KeyboardInterrupt
    return state


def _stopping(
    optim: OptimConfig, rows: dict[str, Any], values: dict[str, float], done: int
) -> str | None:
    """Why a run stops after a stretch, if it has to: only steps to skip, or a state to throw away.

    Args:
        optim: what is allowed.
        rows: metrics of each step, `[count, ...]`.
        values: what is logged of them.
        done: steps up to the end of the stretch.
    """
    if (skipped := rows["in_a_row"].max()) >= optim.max_skipped:
        last = int(rows["in_a_row"].argmax())
        usual = f", or beyond {optim.spike:g} times its mean," if optim.spike else ""
        return (
            f"loss or gradient was not finite{usual} in {skipped} steps in a row (at step "
            f"{done - len(rows['loss']) + last + 1} the loss was {rows['loss'][last]:.3g}, the "
            f"gradient's norm {rows['grad_norm'][last]:.3g})"
        )
    if not math.isfinite(values.get("update_norm", 0.0)):
        return f"an update was not finite up to step {done} though its gradient was"
    return None
