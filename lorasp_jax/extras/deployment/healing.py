"""Heal a form of a run's policy: its adapters train on, with the run's objective and data."""

import dataclasses
from pathlib import Path

from rich.console import Console

import lorasp_jax
from lorasp_jax.config import Config
from lorasp_jax.peft import AdaLoRA
from lorasp_jax.training import dataset, export, loop, rules, start
from lorasp_jax.training.demonstrations import are_cached, demonstrations
from lorasp_jax.training.finished_run import recorded_config
from lorasp_jax.training.replay import with_replayed
from lorasp_jax.training.run import Run
from lorasp_jax.training.run_folder import CONFIG_FILE, read_json
from lorasp_jax.training.step import Objective

RATE = 0.2
"""Learning rate relative to the run's; our choice. LoRA-Squeeze (arXiv 2602.10993), too, tunes for
a few steps what it has compressed."""
WARMUP = 0.1
"""Largest share of the steps in which the learning rate rises; the optimizer starts anew."""


def check(run: Path, task: str = "") -> Config:
    """Return the config of a finished run that can be healed.

    If a task is given and the run has demonstrations, it has that task alone; recordings are one
    dataset, of which `dataset.limit` takes a part.

    Raises:
        ValueError: it is not finished, has learned something other than its data, has adapters that
            cannot train on, or some of its demonstrations are gone; see also `start.with_kept` and
            `check_datasets`.
    """
    config, recorded = recorded_config(run, simulated=False), read_json(run / CONFIG_FILE)
    if task and not config.data.source:
        data = dataclasses.replace(config.data, replay=0.0)
        config = dataclasses.replace(config, tasks=(task,), data=data)
    reasons = {
        "it has learned from its own success, not from data": "online" in recorded,
        "it is distilled to few flow steps, which its data do not teach": "distill" in recorded,
        "its prompts say which actions are good (--learn recap)": config.learn == "recap",
        "its protected directions would not stay": bool(config.protect),
        "it trained its base and has no adapters": rules.trains_base(config),
        "ada_lora has spent its rank budget": any(
            isinstance(method, AdaLoRA) for method in rules.methods(config)
        ),
        f"some of its demonstrations are gone from {run / 'cache'}: put them back, or leave out "
        "--heal": not (config.data.source or are_cached(with_replayed(config), run)),
    }
    if reason := next((text for text, applies in reasons.items() if applies), ""):
        raise ValueError(f"{run} cannot be healed: {reason}")
    check_datasets(run)
    return start.with_kept(config, run, config, (), ())


def check_datasets(run: Path) -> None:
    """Raise ValueError if a run's policy sees each of several datasets in another way.

    A form acts for one of them, and the others' data are not for it.
    """
    if names := export.datasets(export.describe(run)):
        raise ValueError(
            f"the datasets of {run} have statistics or cameras of their own: a form of its policy "
            f"would act for {names[0]}, but learn from all; train with --data.statistics shared"
        )


def heal(
    policy: lorasp_jax.policies.Policy, run: Path, steps: int, task: str = ""
) -> lorasp_jax.policies.Policy:
    """Return a policy whose adapters have trained on with the data of a finished run.

    For the arguments see `train_on`; `run` is the run's folder. With a `task`, its demonstrations
    alone are the data.

    Raises:
        ValueError: see `check`, `dataset.limit` and `loop.train`; or the policy lacks one of the
            instructions.
    """
    data = start.with_data(check(run, task), run, policy.model.config, demonstrations)
    if data.recordings:
        if task:
            dataset.limit(data, task)
    else:  # whose steps refer to all instructions, as the policy does
        spoken = [phrase for group in data.episodes.values() for phrase in group.instructions]
        learned, rows = data.steps, policy.processor.prompts.rows(spoken)
        data.dataset = dataclasses.replace(learned, instruction=rows[learned.instruction])
    return train_on(policy, data, steps)


def train_on(
    policy: lorasp_jax.policies.Policy, run: Run, steps: int, objective: Objective | None = None
) -> lorasp_jax.policies.Policy:
    """Return a policy whose adapters have trained on, on one device; the rest stays as it is.

    The optimizer is the run's, with new moments, without an average, and with a learning rate that
    decays from `RATE` times the run's to its final one.

    Args:
        policy: one with adapters, made from the run's; not modified.
        run: has the config and the data.
        steps: number of gradient steps, at least 1.
        objective: what to learn in place of the demonstrated actions.

    Raises:
        ValueError: see `loop.train`.
    """
    config, console = _config(run.config, steps), Console(stderr=True)
    changes = {"config": config, "console": console, "objective": objective}
    return loop.trained(run.with_policy(policy, **changes))


def _config(config: Config, steps: int) -> Config:
    """Return the config of healing a run on the data that it started with."""
    optim, rate = config.optim, RATE * config.optim.learning_rate
    settings = {
        "steps": steps,
        "learning_rate": rate,
        "final_learning_rate": min(optim.final_learning_rate, rate),
        "warmup_steps": min(optim.warmup_steps, int(WARMUP * steps)),
        "ema": 0.0,  # it would remember what was not healed
    }
    return dataclasses.replace(
        config,
        optim=dataclasses.replace(optim, **settings),
        data=dataclasses.replace(config.data, fresh_every=0),
        fsdp=1,
        checkpoint_every=steps,
    )
