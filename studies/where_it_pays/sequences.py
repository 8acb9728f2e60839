"""Tasks learned one after another by one policy: what does it forget?"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from studies.where_it_pays import names, page
from studies.where_it_pays.judge import padded
from studies.where_it_pays.sequence_page import KINDS, SINGLE, Sequences

RATE = 1e-3
"""Learning rate of all kinds but `SINGLE`, since what is forgotten depends on it."""
REPLAYED = 0.02
"""Share of the demonstrations of earlier tasks that `replay` trains on, too."""
KEPT = 0.5
"""α of `retain`: W ← (1 - α) W_before + α W_after, after each task (RETAIN, arXiv 2512.08333)."""

Demonstrate = Callable[[Run, Mapping[str, float]], Run]
"""Returns a run with demonstrations of some tasks, given the share of those of each."""


def cells(backbone: str, seed: int, pool: int, ranks: Sequence[int]) -> Iterator[Derived]:
    """Yield the policies of a seed that learn one task after another; see `study.Scale`."""
    kinds = [kind for kind in page.SEQUENCES.kinds if KINDS[kind][1] in ranks]
    chosen = dataclasses.replace(page.SEQUENCES, kinds=kinds)
    yield from derived(chosen, backbone, seed, judge, pool=pool)


def derived(
    sequences: Sequences, backbone: str, seed: int, evaluate: Callable[..., Any], **settings: Any
) -> Iterator[Derived]:
    """Yield the policies of a seed that learn one task after another.

    `evaluate` is called with a run, `kind`, `order` and the settings.
    """
    shared = settings | {"replayed": REPLAYED, "kept": KEPT, "least": protect.LEAST}
    for kind in sequences.kinds:
        method, rank, *_ = KINDS[kind]
        source = sequences.together(backbone, method, rank, seed)
        for order, tasks in enumerate(sequences.of_kind(kind)):
            own = functools.partial(evaluate, kind=kind, order=order, **settings)
            name = names.sequence(backbone, kind, order, seed)
            rate = None if kind in SINGLE else RATE
            recorded = {"kind": kind, "tasks": list(tasks), "rate": rate, **shared}
            yield Derived(name, source, settings=recorded, evaluate=own)


def judge(run: Run, kind: str, order: int, pool: int) -> dict[str, Any]:
    """Return what `judged` does, in scenes as recorded."""
    tasks = [task for task in page.SEQUENCES.orders[order] if task in run.config.tasks]
    every = shared_demonstrations(run.folder.parents[3], pool, run.config)

    def demonstrate(stage: Run, shares: Mapping[str, float]) -> Run:
        counts = {t: math.ceil(share * every[t].num_episodes) for t, share in shares.items()}
        return dataclasses.replace(stage, episodes=some(every, counts))

    def success(policy: Policy, shown: Sequence[str]) -> dict[str, str]:
        own = run.with_policy(padded(policy, run.config.targets))
        return scenes.outcomes(own, "recorded", shown)

    return judged(run, kind, tasks, demonstrate, success)


def judged(
    run: Run,
    kind: str,
    tasks: Sequence[str],
    demonstrate: Demonstrate,
    outcomes: Callable[[Policy, Sequence[str]], Mapping[str, str]],
    *,
    whole: bool = True,
) -> dict[str, Any]:
    """Judge a policy while it learns tasks one after another; see `policies`.

    Args:
        run: learned all tasks together.
        kind: one of `sequence_page.KINDS`.
        tasks: in their order.
        demonstrate: chooses demonstrations.
        outcomes: judges a policy on some tasks.
        whole: whether to judge all tasks after each one, and not just that one and the next.

    Returns:
        `outcomes` by number of tasks learned and task, such as "2/pour"; of `SINGLE` kinds of each
        task after itself alone. `protected`: the share of directions that stay after each task.
    """
    found, shares, ends = {}, [], (0, len(tasks))
    for number, (policy, share) in enumerate(policies(run, kind, tasks, demonstrate)):
        shown = tasks if whole or number in ends else tasks[number - 1 : number + 1]
        if kind in SINGLE:
            shown = tasks[:number][-1:]
        texts = outcomes(policy, shown) if shown else {}
        found |= {f"{number}/{task}": text for task, text in texts.items()}
        shares.append(share)
    every = {"outcomes": found, "trainable_parameters": run.parameters[0]}
    return every | ({"protected": shares[1:]} if kind == "protected" else {})


def policies(
    run: Run, kind: str, tasks: Sequence[str], demonstrate: Demonstrate
) -> Iterator[tuple[Policy, float]]:
    """Learn tasks one after another, each with an equal part of the run's steps and warm-up.

    The policy begins with new adapters on the base, its processor is that of the run, which learned
    all tasks together. `SINGLE` kinds have new adapters for each task.

    Yields:
        The policy before the first task and after each, and the share of directions that stay.
    """
    start = setup.build(run.config, run.folder).model
    policy = dataclasses.replace(run.policy, model=start)
    protected: protect.Protected = {}
    yield policy, 0.0
    for number, task in enumerate(tasks, 1):
        if kind in SINGLE:
            policy = dataclasses.replace(policy, model=start)
        earlier = tasks[: number - 1] if kind == "replay" else ()
        shares = {task: 1.0} | dict.fromkeys(earlier, REPLAYED)
        stage = demonstrate(_stage(run, kind, len(tasks)), shares)
        stage.policy = policy
        if protected:  # the first task trains all
            stage.fixed = protect.fixed(policy.model, protected)
        policy = loop.trained(stage)
        if kind == "protected":
            protected = protect.in_use(stage, policy.model, policy.processor, protected)
        if kind == "retain":
            model = _interpolated(policy.model, run.config, number)
            policy = dataclasses.replace(policy, model=model)
        yield policy, float(np.mean([rows.mean() for rows in protected.values()] or [0.0]))


def some(every: Demonstrations, counts: Mapping[str, int]) -> Demonstrations:
    """Return the first demonstrations of some tasks, given their numbers.

    The others have none, but stay: steps refer to the instructions of all by number.
    """
    return {task: group.select(np.arange(counts.get(task, 0))) for task, group in every.items()}


def _stage(run: Run, kind: str, count: int) -> Run:
    """Return a run that is to learn one of `count` tasks; `SINGLE` kinds keep the tuned rate."""
    optim = run.config.optim
    steps, warmup = optim.steps // count, optim.warmup_steps // count
    rate = optim.learning_rate if kind in SINGLE else RATE
    optim = dataclasses.replace(optim, steps=steps, warmup_steps=warmup, learning_rate=rate)
    config = dataclasses.replace(run.config, optim=optim, checkpoint_every=steps, log_every=steps)
    if kind == "no_spectral":
        auxiliary = dataclasses.replace(config.auxiliary, spectral=0.0)
        config = dataclasses.replace(config, auxiliary=auxiliary)
    return dataclasses.replace(run, config=config)


def _interpolated(model: Backbone, config: Config, number: int) -> Backbone:
    """Merge `KEPT` of what LoRA has learned into the base, and return it with new adapters."""
    graphdef, adapters, frozen = adaptation.split(model)
    shrink = lambda path, x: KEPT * x if path[-1].key == "lora_b" else x  # noqa: E731
    adapters = jax.tree_util.tree_map_with_path(shrink, adapters)
    merged = lorasp_jax.merge(nnx.merge(graphdef, adapters, frozen))
    key = jax.random.fold_in(RandomStream.ADAPTERS.key(config.seed), number)
    return adaptation.adapt(merged, rules.rules(config), rngs=nnx.Rngs(key))
