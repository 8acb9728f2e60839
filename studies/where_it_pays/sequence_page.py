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
    "sequential": ("lora", WIDE, "LoRA", ""),
    "replay": ("lora", WIDE, "LoRA, 2 % of earlier demonstrations", "sequential"),
    "retain": ("lora", WIDE, "LoRA, half of each update merged", "sequential"),
    "sequential_sp": ("lora_sp", WIDE, "LoRA-SP", "sequential"),
    "no_spectral": ("lora_sp", WIDE, "LoRA-SP without spectral loss", "sequential_sp"),
    "protected": ("lora_sp", WIDE, "LoRA-SP, used directions protected", "sequential_sp"),
    "single": ("lora", WIDE, "one LoRA per task, r = 64", ""),
    "single_r16": ("lora", 16, "one LoRA per task, r = 16", ""),
}
"""How tasks are learned one after another -> method, R, label, and the kind that it changes."""
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


def last(rates: Rates, order: Order) -> np.ndarray:
    """Success in the last task."""
    return rates[-1][..., order[-1]]


def forgotten(rates: Rates, order: Order) -> np.ndarray:
    """Mean fall of success from right after a task was learned to the end; not the last's.

    This is minus the backward transfer. The fall from the best of all later stages would be biased.
    """
    falls = [rates[k + 1][..., task] - rates[-1][..., task] for k, task in enumerate(order[:-1])]
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
        row = [page.percent(rate) if rate else page.NONE, *[page.NONE] * 7, str(len(found))]
        rows.append([f"{label}, all tasks together", *row])
    for kind, (_, _, label, _) in KINDS.items():
        row, count = _row(results, backbone, kind)
        rows.append([label, *row, str(count)])
    heads = ["at the end", "minus together", "right after learning", "of these, the last"]
    heads += ["forgotten", "minus", "gained before learning", "directions protected", "seeds"]
    return page.table([f"{BACKBONES[backbone]}, success [%]", *heads], rows)


def _row(results: Results, backbone: str, kind: str) -> tuple[list[str], int]:
    """Return the numbers of a kind, and of how many seeds they are."""
    method, _, _, changed = KINDS[kind]
    together = [names.cell(backbone, method, WIDE, seed) for seed in SEEDS]
    *found, joint = names.ran(results, *_policies(backbone, kind), together)
    if not joint:
        return [page.NONE] * 8, 0
    count = len(ORDERS[0])
    if kind in SINGLE:
        own = np.concatenate([outcomes(found[0], str(k + 1)) for k in range(count)], axis=1)
        own = own[:, [*np.argsort(ORDERS[0])]]  # tasks in order of name
        minus = page.points(statistics.difference(own, outcomes(joint, "recorded")))
        rate = page.percent(statistics.success(own))
        return [rate, minus, rate, *[page.NONE] * 5], len(joint)
    ends = [outcomes(each, str(count)) for each in found]
    minus = statistics.bootstrap(_mean_minus, outcomes(joint, "recorded"), *ends)
    row = [page.percent(estimate(at_end, found)), page.points(minus)]
    row += [page.percent(estimate(statistic, found)) for statistic in (learned, last)]
    row += [page.points(estimate(forgotten, found)), page.NONE]
    if changed:
        both = names.ran(results, *_policies(backbone, kind), *_policies(backbone, changed))
        row[-1] = page.points(estimate(forgotten, both)) if both[0] else page.NONE
    shares = [each["protected"][-1] for order in found for each in order if "protected" in each]
    share = f"{100 * np.mean(shares):.0f} %" if shares else page.NONE
    return [*row, page.points(estimate(before, found)), share], len(joint)


def _policies(backbone: str, kind: str) -> list[list[str]]:
    """Return the names of the policies of a kind by order and seed."""
    orders = range(1 if kind in SINGLE else len(ORDERS))
    return [[names.sequence(backbone, kind, order, seed) for seed in SEEDS] for order in orders]


def _mean_minus(joint: np.ndarray, *ends: np.ndarray) -> np.ndarray:
    return np.mean([statistics.minus(end, joint) for end in ends], axis=0)


def estimate(
    statistic: Callable[[Rates, Order], np.ndarray], found: Sequence[Sequence[Mapping[str, Any]]]
) -> Estimate:
    """Estimate a statistic, averaged over `ORDERS`, from the results of each by seed.

    With the results of a second kind behind those of the first, estimate the difference.
    """
    order = [[sorted(tasks).index(task) for task in tasks] for tasks in ORDERS]
    count = len(ORDERS[0]) + 1

    def mean(*rates: np.ndarray) -> np.ndarray:
        each = [rates[i * count : (i + 1) * count] for i in range(len(found))]
        values = [statistic(x, order[i % len(ORDERS)]) for i, x in enumerate(each)]
        first, second = values[: len(ORDERS)], values[len(ORDERS) :]
        return np.mean(first, axis=0) - (np.mean(second, axis=0) if second else 0.0)

    return statistics.bootstrap(
        mean, *(outcomes(each, str(k)) for each in found for k in range(count))
    )
