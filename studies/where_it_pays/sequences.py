"""Tasks learned one after another by one policy: what does it forget?"""

import dataclasses
import functools
import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import adaptation
from lorasp_jax.config import Config
from lorasp_jax.extras.study import Derived
from lorasp_jax.extras.study.held_out import shared_demonstrations
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training import loop, protect, rules, setup
from lorasp_jax.training.demonstrations import Demonstrations
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run import Run
from studies.few import judge as scenes
from studies.where_it_pays import names, sequence_page
from studies.where_it_pays.judge import padded
from studies.where_it_pays.sequence_page import ORDERS, SINGLE

RATE = 1e-3
"""Learning rate of all kinds, since what is forgotten depends on it."""
REPLAYED = 0.02
"""Share of the demonstrations of earlier tasks that `replay` trains on, too."""
KEPT = 0.5
"""α of `retain`: W ← (1 - α) W_before + α W_after, after each task (RETAIN, arXiv 2512.08333)."""


def cells(backbone: str, seed: int, pool: int, ranks: Sequence[int]) -> Iterator[Derived]:
    """Yield the policies of a seed that learn one task after another; see `study.Scale`."""
    for kind, (method, rank, *_) in sequence_page.KINDS.items():
        if rank not in ranks:
            continue
        source = names.cell(backbone, method, rank, seed)
        for order in range(1 if kind in SINGLE else len(ORDERS)):
            evaluate = functools.partial(judge, kind=kind, order=order, pool=pool)
            name = names.sequence(backbone, kind, order, seed)
            settings = {"kind": kind, "tasks": list(ORDERS[order]), "rate": RATE, "pool": pool}
            settings |= {"replayed": REPLAYED, "kept": KEPT, "least": protect.LEAST}
            yield Derived(name, source, settings=settings, evaluate=evaluate)


def judge(run: Run, kind: str, order: int, pool: int) -> dict[str, Any]:
    """Learn the tasks one after another, each with an equal part of the run's steps and warm-up.

    The policy begins with new adapters on the base, its processor is that of the run, which learned
    all tasks together. `SINGLE` kinds have new adapters for each task.

    Returns:
        `outcomes` by number of tasks learned and task, such as "2/pour", in scenes as recorded; of
        `SINGLE` kinds of each task after itself alone. `protected`: the share of directions that
        stay after each task.
    """
    config, tasks = run.config, [task for task in ORDERS[order] if task in run.config.tasks]
    study_folder = run.folder.parents[3]
    every = shared_demonstrations(study_folder, pool, config, run.folder, lambda *_: None)
    start = setup.build(config, run.folder).model
    policy = dataclasses.replace(run.policy, model=start)
    single = kind in SINGLE
    outcomes = {} if single else _outcomes(run, policy, 0, tasks)
    protected: protect.Protected = {}
    shares = []
    for number, task in enumerate(tasks, 1):
        if single:
            policy = dataclasses.replace(policy, model=start)
        counts = {task: every[task].num_episodes}
        if kind == "replay":
            counts |= {t: math.ceil(REPLAYED * every[t].num_episodes) for t in tasks[: number - 1]}
        stage = _stage(run, kind, len(tasks))
        stage.policy, stage.episodes = policy, some(every, counts)
        if protected:  # the first task trains all
            stage.fixed = protect.fixed(policy.model, protected)
        policy = learned(stage)
        if kind == "protected":
            protected = protect.in_use(stage, policy.model, policy.processor, protected)
            shares.append(float(np.mean([rows.mean() for rows in protected.values()])))
        if kind == "retain":
            policy = dataclasses.replace(policy, model=_interpolated(policy.model, config, number))
        outcomes |= _outcomes(run, policy, number, [task] if single else tasks)
    found = {"outcomes": outcomes, "trainable_parameters": run.parameters[0]}
    return found | ({"protected": shares} if shares else {})


def some(every: Demonstrations, counts: Mapping[str, int]) -> Demonstrations:
    """Return the first demonstrations of some tasks, given their numbers.

    The others have none, but stay: steps refer to the instructions of all by number.
    """
    return {task: group.select(np.arange(counts.get(task, 0))) for task, group in every.items()}


def _stage(run: Run, kind: str, count: int) -> Run:
    """Return a run that is to learn one of `count` tasks."""
    optim = run.config.optim
    steps, warmup = optim.steps // count, optim.warmup_steps // count
    optim = dataclasses.replace(optim, steps=steps, warmup_steps=warmup, learning_rate=RATE)
    config = dataclasses.replace(run.config, optim=optim, checkpoint_every=steps, log_every=steps)
    if kind == "no_spectral":
        auxiliary = dataclasses.replace(config.auxiliary, spectral=0.0)
        config = dataclasses.replace(config, auxiliary=auxiliary)
    return dataclasses.replace(run, config=config)


def learned(run: Run) -> Policy:
    """Train a run on one device, without files in its folder; return its policy."""
    with tempfile.TemporaryDirectory() as folder:
        trained = dataclasses.replace(run, folder=Path(folder), devices=jax.devices()[:1])
        trained.policy = run.policy
        loop.train(trained)
    return trained.policy


def _interpolated(model: Backbone, config: Config, number: int) -> Backbone:
    """Merge `KEPT` of what LoRA has learned into the base, and return it with new adapters."""
    graphdef, adapters, frozen = adaptation.split(model)
    shrink = lambda path, x: KEPT * x if path[-1].key == "lora_b" else x  # noqa: E731
    adapters = jax.tree_util.tree_map_with_path(shrink, adapters)
    merged = lorasp_jax.merge(nnx.merge(graphdef, adapters, frozen))
    key = jax.random.fold_in(RandomStream.ADAPTERS.key(config.seed), number)
    return adaptation.adapt(merged, rules.rules(config), rngs=nnx.Rngs(key))


def _outcomes(run: Run, policy: Policy, number: int, tasks: list[str]) -> dict[str, str]:
    """Return the outcomes of a policy after a number of tasks."""
    shown = dataclasses.replace(run, config=dataclasses.replace(run.config, tasks=tuple(tasks)))
    shown.policy = padded(policy, run.config.targets)
    found = scenes.judge(shown, ("recorded",))["outcomes"]
    return {f"{number}/{name.partition('/')[2]}": text for name, text in found.items()}
