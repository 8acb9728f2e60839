"""The tables of policies that learn one task after another."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from lorasp_jax.extras.study import page, statistics
from lorasp_jax.extras.study.page import BACKBONES
from lorasp_jax.extras.study.statistics import Estimate
from lorasp_jax.extras.study.study import Results
from studies.few.page import outcomes
from studies.where_it_pays import names
from studies.where_it_pays.names import METHODS, SEEDS, WIDE

KINDS = {
    "sequential": ("lora", WIDE, "LoRA"),
    "sequential_sp": ("lora_sp", WIDE, "LoRA-SP"),
    "protected": ("lora_sp", WIDE, "LoRA-SP, used directions protected"),
    "replay": ("lora", WIDE, "LoRA, 2 % of earlier demonstrations"),
    "retain": ("lora", WIDE, "LoRA, half of each update merged"),
    "single": ("lora", WIDE, "one LoRA per task, r = 64"),
    "single_r16": ("lora", 16, "one LoRA per task, r = 16"),
}
"""How tasks are learned one after another -> method, R and label."""
SINGLE = ("single", "single_r16")
"""Kinds whose tasks have adapters of their own, so that their order does not matter."""
ORDERS = (("press", "open_pot", "pick_place", "pour"), ("pour", "pick_place", "open_pot", "press"))
"""Orders of tasks."""

Rates = Sequence[np.ndarray]
"""Success rates `[..., T]` after 0 to T tasks, tasks in order of name."""
Order = Sequence[int]
"""Which of the tasks by name is learned first, second, ..."""


def at_end(rates: Rates, order: Order) -> np.ndarray:
    """Mean success after the last task."""
    del order
    return rates[-1].mean(-1)


def learned(rates: Rates, order: Order) -> np.ndarray:
    """Mean success in each task right after it was learned."""
    return np.mean([rates[k + 1][..., task] for k, task in enumerate(order)], axis=0)


def forgotten(rates: Rates, order: Order) -> np.ndarray:
    """Mean fall of success from its best, after a task was learned, to the end; not the last's."""
    falls = [
        np.max([rate[..., task] for rate in rates[k + 1 :]], axis=0) - rates[-1][..., task]
        for k, task in enumerate(order[:-1])
    ]
    return np.mean(falls, axis=0)


def before(rates: Rates, order: Order) -> np.ndarray:
    """Mean success in a task right before it is learned, minus the base's; not the first's."""
    gains = [rates[k][..., task] - rates[0][..., task] for k, task in enumerate(order) if k]
    return np.mean(gains, axis=0)


def table(results: Results, backbone: str) -> str:
    """Return what policies that learn one task after another can do, learn and forget."""
    rows = []
    for method, label in METHODS.items():
        (found,) = names.ran(results, [names.cell(backbone, method, WIDE, s) for s in SEEDS])
        rate = statistics.success(outcomes(found, "recorded")) if found else None
        row = [page.percent(rate) if rate else page.NONE, *[page.NONE] * 3, str(len(found))]
        rows.append([f"{label}, all tasks together", *row])
    for kind, (_, _, label) in KINDS.items():
        orders = range(1 if kind in SINGLE else len(ORDERS))
        policies = [[names.sequence(backbone, kind, o, s) for s in SEEDS] for o in orders]
        found = names.ran(results, *policies)
        rows.append([label, *_row(kind, found), str(len(found[0]))])
    heads = ["at the end", "right after learning", "forgotten", "gained before learning", "seeds"]
    return page.table([f"{BACKBONES[backbone]}, success [%]", *heads], rows)


def _row(kind: str, found: Sequence[Sequence[Mapping[str, Any]]]) -> list[str]:
    if not found[0]:
        return [page.NONE] * 4
    if kind in SINGLE:
        own = [outcomes(found[0], str(k + 1)) for k in range(len(ORDERS[0]))]
        rate = page.percent(statistics.success(np.concatenate(own, axis=1)))
        return [rate, rate, page.NONE, page.NONE]
    rates = [page.percent(estimate(statistic, found)) for statistic in (at_end, learned)]
    return rates + [page.points(estimate(statistic, found)) for statistic in (forgotten, before)]


def estimate(
    statistic: Callable[[Rates, Order], np.ndarray], found: Sequence[Sequence[Mapping[str, Any]]]
) -> Estimate:
    """Estimate a statistic, averaged over `ORDERS`, from the results of each by seed."""
    order = [[sorted(tasks).index(task) for task in tasks] for tasks in ORDERS]
    count = len(ORDERS[0]) + 1

    def mean(*rates: np.ndarray) -> np.ndarray:
        each = [rates[i * count : (i + 1) * count] for i in range(len(ORDERS))]
        return np.mean([statistic(x, own) for x, own in zip(each, order, strict=True)], axis=0)

    return statistics.bootstrap(
        mean, *(outcomes(each, str(k)) for each in found for k in range(count))
    )
