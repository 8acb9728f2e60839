"""The loop of online learning: collect, update, log, save."""

import contextlib
import time
from collections.abc import Mapping, Sequence

import numpy as np

from lorasp_jax.base.bars import bars
from lorasp_jax.base.intervals import wilson_interval
from lorasp_jax.reinforce import ppo, steering, teaching
from lorasp_jax.reinforce.config import ReinforceConfig
from lorasp_jax.reinforce.learner import Learner
from lorasp_jax.reinforce.setting import Setting, prepare
from lorasp_jax.training import best, records
from lorasp_jax.training.checkpoint import Checkpoints
from lorasp_jax.training.interrupt import deferred
from lorasp_jax.training.loop import RunError, training
from lorasp_jax.training.run import Callback, Run
from lorasp_jax.training.run_folder import MetricsLog, read_json, read_metrics


def train(run: Run, callbacks: Sequence[Callback] = (), *, resume: bool = False) -> None:
    """Improve `run.policy` by trial, then set it to the best policy that was evaluated.

    With `resume`, it continues from the newest checkpoint, if there is one.

    Raises:
        RunError: too many consecutive updates were skipped.
        KeyboardInterrupt: a signal stopped the run; the state is saved first.
    """
    fixed, initial, shapes = prepare(run)
    checkpoints = Checkpoints(run.folder, run.base_hash, run.console)
    restored = checkpoints.restore(shapes) if resume else None
    if restored is None:
        for callback in callbacks:
            callback.on_start(run)
        before = read_json(run.folder / "before.json", records.BEFORE)
        _keep_best(run, 0, {f"success/{task}": x["success"] for task, x in before.items()})
    with training(run, checkpoints, callbacks):
        state = _loop(run, fixed, restored or initial, checkpoints, callbacks)
    run.policy = fixed.policy(state.adapters)
    if best.error(run.folder) < float("inf"):
        step, run.policy = best.load(run.folder, run.policy)
        of = f"iteration {step}" if step else "the start"
        run.console.print(f"kept the adapters of {of}, the best that were evaluated")
    for callback in callbacks:
        callback.on_end(run)


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
        reason = clock.collapse(config, clock.last) if clock.last else ""
        while (done := int(state.step)) < total and not reason and not stop.requested:
            state, values = _ITERATE[config.online.method](setting, state)
            done += 1
            if values.pop("in_a_row") >= config.optim.max_skipped:
                raise RunError(_SKIPPED.format(config.optim.max_skipped, saved))
            values = clock.count(values)
            reason = clock.collapse(config, values)
            run.policy, run.stops = setting.policy(state.adapters), bool(reason)
            for callback in callbacks:
                values = values | (callback.on_log(run, done, values) or {})
            _keep_best(run, done, values)
            log.write(done, values)
            progress.update(bar, completed=done, description=_text(values))
            if done // config.checkpoint_every > saved // config.checkpoint_every:
                checkpoints.save(state)
                saved = done
        checkpoints.save(state)
    if reason:
        run.console.print(f"stopped after iteration {done}: {reason}")
    elif stop.requested:
        raise KeyboardInterrupt
    return state


_ITERATE = {"teacher": teaching.iterate, "ppo": ppo.iterate, "noise": steering.iterate}
_SKIPPED = (
    "{} consecutive updates were skipped because loss or gradient was non-finite; nothing after "
    "iteration {} was saved: try a lower --optim.learning-rate"
)


class _Clock:
    """Environment steps and minutes of a run, and the success that it began with."""

    def __init__(self, run: Run, saved: int) -> None:
        rows = [row for row in read_metrics(run.folder) if row["step"] <= saved]
        self.last: dict[str, float] = rows[-1] if rows else {}
        self._steps, self._first = self.last.get("environment_steps", 0), rows[0] if rows else {}
        self._began = time.perf_counter() - 60 * self.last.get("minutes", 0)

    def count(self, values: dict[str, float]) -> dict[str, float]:
        """Replace the steps of an iteration by those of the run, and add the minutes."""
        self._steps += values.pop("steps")
        minutes = (time.perf_counter() - self._began) / 60
        self._first = self._first or values
        return values | {"environment_steps": self._steps, "minutes": minutes}

    def collapse(self, config: ReinforceConfig, values: Mapping[str, float]) -> str:
        """Say in a sentence why going on is useless; "" if it is not."""
        if 0 < config.online.minutes <= values.get("minutes", 0):
            return f"it has learned for {values['minutes']:.1f} minutes"
        now, first = (
            round(sum(config.online.worlds * row[f"rollout/{task}"] for task in config.tasks))
            for row in (values, self._first)
        )
        found = now or first or any(values.get(f"teacher/{task}", 0) for task in config.tasks)
        if config.online.reward == "sparse" and not found:
            return "no episode succeeded: start from a run that succeeds more often"
        if (kl := values.get("start_kl", 0)) > config.online.max_start_kl:
            return (
                f"the KL divergence from the start policy is {kl:.1f}, above "
                f"{config.online.max_start_kl:g}: try a lower --optim.learning-rate"
            )
        episodes = config.online.worlds * len(config.tasks)
        low, high = wilson_interval(first, episodes)[0], wilson_interval(now, episodes)[1]
        if now < first / 2 and high < low:  # not by chance
            return (
                f"success of the rollouts fell from {first} to {now} of {episodes} episodes: try a "
                "lower --optim.learning-rate"
            )
        return ""


def _text(values: Mapping[str, float]) -> str:
    """Return the text of the bar."""
    rates = [f"{100 * x:.0f} %" for name, x in values.items() if name.startswith("rollout/")]
    return f"success {', '.join(rates)}"


def _keep_best(run: Run, step: int, values: Mapping[str, float]) -> None:
    """Save the adapters if they were evaluated, and more episodes failed with all before."""
    rates = [x for name, x in values.items() if name.startswith("success/")]
    if rates and (error := 1 - float(np.mean(rates))) < best.error(run.folder):
        best.save(run.folder, run.policy, step, error)
