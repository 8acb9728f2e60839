"""The loop of online learning: collect, update, log, save."""

import contextlib
import dataclasses
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

import envs
from envs.env import Env
from lorasp_jax.adapters import adaptation
from lorasp_jax.base.bars import bars
from lorasp_jax.policies.policy import Policy
from lorasp_jax.reinforce import critic, noise, rollout, update
from lorasp_jax.reinforce.config import Learning, ReinforceConfig
from lorasp_jax.reinforce.critic import Critic
from lorasp_jax.reinforce.rollout import Rollout
from lorasp_jax.reinforce.update import Batch, Learner
from lorasp_jax.training import best
from lorasp_jax.training.checkpoint import Checkpoints
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.guard import Guard, summarize
from lorasp_jax.training.interrupt import deferred
from lorasp_jax.training.loop import RunError
from lorasp_jax.training.optim import make_optimizer
from lorasp_jax.training.program import Frozen
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import MetricsLog, read_metrics


class Setting(NamedTuple):
    """What does not change during a run.

    Attributes:
        environments: by task.
        start: the adapters at the start, from which the KL divergence is measured.
        policy: from adapters to the policy.
        shardings: of the state.
    """

    config: ReinforceConfig
    environments: Mapping[str, Env]
    programs: update.Programs
    frozen: Frozen
    start: Any
    policy: Callable[[Any], Policy]
    shardings: Learner


def train(run: Run, callbacks: Sequence[Callback] = (), *, resume: bool = False) -> None:
    """Improve `run.policy` by trial, then set it to the best policy that was evaluated.

    With `resume`, it continues from the newest checkpoint, if there is one.

    Raises:
        RunError: too many consecutive updates were skipped.
        KeyboardInterrupt: a signal stopped the run; the state is saved first.
    """
    setting, initial, shapes = _set_up(run)
    checkpoints = Checkpoints(run.folder, run.base_hash, run.console)
    restored = checkpoints.restore(shapes) if resume else None
    if restored is None:
        for callback in callbacks:
            callback.on_start(run)
    try:
        with run.timed("train"):
            state = _loop(run, setting, restored or initial, checkpoints, callbacks)
    except RunError as error:
        for callback in callbacks:
            callback.on_stop(run, str(error))
        raise
    finally:
        checkpoints.close()
    run.policy = setting.policy(state.adapters)
    if best.error(run.folder) < float("inf"):
        step, run.policy = best.load(run.folder, run.policy)
        run.console.print(f"kept the adapters of iteration {step}, the best that were evaluated")
    for callback in callbacks:
        callback.on_end(run)


def _set_up(run: Run) -> tuple[Setting, Learner, Any]:
    """Return the setting, the initial state, and the state's shapes."""
    config = run.config
    assert isinstance(config, ReinforceConfig)
    learning, evaluation = config.learn, config.evaluation
    environments = {task: _environment(config, task) for task in config.tasks}
    check_memory(config, environments)
    mesh = meshes.make_mesh(config.fsdp, run.devices)
    graphdef, adapters, parameters = adaptation.split(run.policy.model)
    methods = adaptation.methods(run.policy.model).values()
    chunks = sum(
        env.num_envs * -(-env.max_steps // evaluation.execute_steps)
        for env in environments.values()
    )
    most = config.optim.steps * learning.epochs * -(-chunks // config.optim.batch_size)
    optimizer = make_optimizer(dataclasses.replace(config.optim, steps=most), methods)
    zero = jnp.zeros((), jnp.int32)
    critics = _critics(config, environments)
    adapters = jax.tree.map(jnp.copy, adapters)
    state = Learner(zero, adapters, optimizer.init(adapters), Guard.initial(), critics)
    shardings = meshes.shardings(state, mesh)
    state = jax.device_put(state, shardings)
    processor = run.policy.processor
    frozen = Frozen(parameters, processor.shared())
    frozen = jax.device_put(frozen, meshes.shardings(frozen, mesh))
    start = jax.tree.map(jnp.copy, state.adapters)
    weights = {name: getattr(config.auxiliary, name) for name in vars(config.auxiliary)}
    options = learning, evaluation.denoise_steps, weights, config.optim.spike
    programs = update.Programs(graphdef, optimizer, *options, shardings)

    def policy(adapters: Any) -> Policy:
        return Policy(nnx.merge(graphdef, adapters, frozen.parameters), processor)

    run.policy = policy(start)
    shapes = jax.tree.map(meshes.with_sharding, jax.eval_shape(lambda: state), shardings)
    setting = Setting(config, environments, programs, frozen, start, policy, shardings)
    return setting, state, shapes


def _environment(config: ReinforceConfig, task: str) -> Env:
    return envs.make(
        task,
        robot=config.robot,
        num_envs=config.learn.worlds,
        image_size=config.image_size,
        control_dt=config.control_dt,
        reward=config.learn.reward,
        discount=config.learn.discount,
    )


def check_memory(config: ReinforceConfig, environments: Mapping[str, Env]) -> None:
    """Raise ValueError if the pictures of an iteration exceed the memory of the devices."""
    calls = sum(-(-x.max_steps // config.evaluation.execute_steps) for x in environments.values())
    pictures = len(Env.cameras) * config.image_size**2 * 3
    needed = calls * config.learn.worlds * pictures / jax.local_device_count()
    if needed > (available := preflight.available_bytes()):
        raise ValueError(
            f"the pictures of {config.learn.worlds} worlds (learn.worlds) take "
            f"{needed / 2**30:.1f} GiB per device of {available / 2**30:.1f}: choose fewer worlds"
        )


def _critics(config: ReinforceConfig, environments: Mapping[str, Env]) -> dict[str, Critic]:
    if config.learn.advantages == "group":
        return {}
    return {
        task: Critic.init(
            RandomStream.CRITIC.key(config.seed, task),
            max(part.stop for part in env.full_state_layout.values()) + 1,
            config.learn.critic_learning_rate,
        )
        for task, env in environments.items()
    }


def _loop(
    run: Run,
    setting: Setting,
    state: Learner,
    checkpoints: Checkpoints,
    callbacks: Sequence[Callback],
) -> Learner:
    """Run iterations until the last one, a collapse, or a signal to stop."""
    config, saved = setting.config, int(state.step)
    total, clock = config.optim.steps, _Clock(run, saved)
    with (
        contextlib.closing(MetricsLog(run.folder, saved)) as log,
        deferred() as stop,
        bars(run.console, "iterations") as progress,
    ):
        bar = progress.add_task("compiling ...", total=total, completed=saved)
        reason = ""
        while (done := int(state.step)) < total and not reason and not stop.requested:
            state, values = iterate(setting, state)
            done += 1
            if values.pop("in_a_row") >= config.optim.max_skipped:
                raise RunError(_SKIPPED.format(config.optim.max_skipped, saved))
            values = clock.count(values)
            run.policy = setting.policy(state.adapters)
            for callback in callbacks:
                values = values | (callback.on_log(run, done, values) or {})
            _keep_best(run, done, values)
            log.write(done, values)
            progress.update(bar, completed=done, description=_text(values))
            reason = clock.collapse(config, values)
            if done // config.checkpoint_every > saved // config.checkpoint_every:
                checkpoints.save(state)
                saved = done
        checkpoints.save(state)
    if reason:
        run.console.print(f"stopped after iteration {done}: {reason}")
    elif stop.requested:
        raise KeyboardInterrupt
    return state


_SKIPPED = (
    "{} consecutive updates were skipped because loss or gradient was non-finite; nothing after "
    "iteration {} was saved: try a lower --optim.learning-rate"
)


class _Clock:
    """Environment steps and minutes of a run, and the success that it began with."""

    def __init__(self, run: Run, saved: int) -> None:
        rows = [row for row in read_metrics(run.folder) if row["step"] <= saved]
        last = rows[-1] if rows else {"environment_steps": 0, "minutes": 0}
        self._steps, self._first = last["environment_steps"], rows[0] if rows else {}
        self._began = time.perf_counter() - 60 * last["minutes"]

    def count(self, values: dict[str, float]) -> dict[str, float]:
        """Replace the steps of an iteration by those of the run, and add the minutes."""
        self._steps += values.pop("steps")
        minutes = (time.perf_counter() - self._began) / 60
        self._first = self._first or values
        return values | {"environment_steps": self._steps, "minutes": minutes}

    def collapse(self, config: ReinforceConfig, values: Mapping[str, float]) -> str:
        """Say in a sentence why the policy has collapsed; "" if it has not."""
        if (kl := values.get("start_kl", 0)) > config.learn.max_start_kl:
            return (
                f"the KL divergence from the start policy is {kl:.1f}, above "
                f"{config.learn.max_start_kl:g}: try a lower --optim.learning-rate"
            )
        for task in config.tasks:
            now, first = values[f"rollout/{task}"], self._first[f"rollout/{task}"]
            if now < first / 2:
                return (
                    f"success with noise in {task} fell from {100 * first:.0f} % to "
                    f"{100 * now:.0f} %: try a lower --optim.learning-rate"
                )
        return ""


def _text(values: Mapping[str, float]) -> str:
    """Return the text of the bar."""
    rates = [f"{100 * x:.0f} %" for name, x in values.items() if name.startswith("rollout/")]
    return f"success with noise {', '.join(rates)}"


def _keep_best(run: Run, step: int, values: Mapping[str, float]) -> None:
    """Save the adapters if they were evaluated, and more episodes failed with all before."""
    rates = [x for name, x in values.items() if name.startswith("success/")]
    if rates and (error := 1 - float(np.mean(rates))) < best.error(run.folder):
        best.save(run.folder, run.policy, step, error)


def iterate(setting: Setting, state: Learner) -> tuple[Learner, dict[str, float]]:
    """Collect and learn once; return the state and the metrics, with the environment `steps`."""
    config, step = setting.config, int(state.step)
    learning, evaluation = config.learn, config.evaluation
    policy, critics, values = setting.policy(state.adapters).with_sampler(), {}, {}
    batches: list[Batch] = []
    for task, env in setting.environments.items():
        key = jax.random.fold_in(RandomStream.ROLLOUTS.key(config.seed, task), step)
        found = rollout.collect(
            env,
            policy,
            key,
            learning.std,
            execute_steps=evaluation.execute_steps,
            denoise_steps=evaluation.denoise_steps,
            group=learning.group if learning.advantages == "group" else 1,
            ranges=config.ranges,
        )
        advantages, critics[task], metrics = _advantages(
            learning, state.critics.get(task), found, key
        )
        batches.append(_batch(found, advantages, evaluation.execute_steps))
        values |= {f"{name}/{task}": float(x) for name, x in metrics.items()}
        values[f"rollout/{task}"] = float(jnp.mean(found.success))
        values["steps"] = values.get("steps", 0) + float(jnp.sum(~found.steps.done))
    batch = jax.tree.map(lambda *x: jnp.concatenate(x), *batches)
    rng = np.random.default_rng([config.seed, step])
    sizes = rng, config.optim.batch_size, learning.epochs
    state, batch, rows = update.improve(setting.programs, state, setting.frozen, batch, *sizes)
    values |= _summary(setting, state, batch, rows)
    critics = {task: x for task, x in critics.items() if x is not None}
    state = dataclasses.replace(state, step=state.step + 1, critics=critics)
    return jax.device_put(state, setting.shardings), values


def _advantages(
    learning: Learning, old: Critic | None, found: Rollout, key: jax.Array
) -> tuple[jax.Array, Critic | None, dict[str, jax.Array]]:
    """Return advantages `[T, W]` normalized over the task, the critic and its metrics."""
    running = ~found.steps.done
    if old is None:
        count = jnp.argmax(found.steps.ended, axis=0) + 1
        each = critic.group_advantages(found.success, count, learning.group, learning.discount)
        advantages, new, metrics = jnp.broadcast_to(each, running.shape), None, {}
    else:
        options = {"discount": learning.discount, "trace": learning.trace}
        rate = learning.critic_learning_rate
        advantages, new, metrics = _learn(old, found.steps, found.last, key, **options, rate=rate)
        advantages -= jnp.mean(advantages, where=running)
    scale = jnp.sqrt(jnp.mean(jnp.square(advantages), where=running)) + 1e-8
    return jnp.where(running, advantages / scale, 0), new, metrics


def _batch(found: Rollout, advantages: jax.Array, execute_steps: int) -> Batch:
    """Arrange steps `[calls x S, W]` as chunks `[calls x W, S]`."""
    worlds = advantages.shape[1]

    def arrange(x: jax.Array) -> jax.Array:
        return jnp.moveaxis(x.reshape(-1, execute_steps, worlds), 1, 2).reshape(-1, execute_steps)

    means = jnp.zeros_like(found.chunks.actions)
    return Batch(found.chunks, means, arrange(advantages), arrange(~found.steps.done))


def _summary(
    setting: Setting, state: Learner, batch: Batch, rows: dict[str, np.ndarray]
) -> dict[str, float]:
    """Return the means of the metrics of the gradient steps, and the divergence from the start."""
    if not rows:
        return {"updates": 0, "in_a_row": 0}
    values = {n: float(x.mean()) for n, x in summarize(rows).items() if x.ndim == 0}
    index = np.arange(setting.config.optim.batch_size) % len(batch.valid)
    now, start = (
        setting.programs.means(x, setting.frozen, batch.chunks, index)
        for x in (state.adapters, setting.start)
    )
    slots = noise.action_slots(setting.frozen.processor)
    kl = noise.divergence(now, start, setting.config.learn.std, slots)
    extra = {"start_kl": float(jnp.mean(kl)), "in_a_row": float(rows["in_a_row"][-1])}
    return values | extra | {"updates": len(rows["loss"]), "last_kl": float(rows["kl"][-1])}


_learn = functools.partial(jax.jit, static_argnames=("discount", "trace", "rate"))(critic.learn)
