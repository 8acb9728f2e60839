"""The tables of policies that learn one task after another."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lorasp_jax.extras.study import page, statistics
from lorasp_jax.extras.study.page import BACKBONES
from lorasp_jax.extras.study.results import ran
from lorasp_jax.extras.study.statistics import Estimate
from lorasp_jax.extras.study.study import Results
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


@dataclass(frozen=True)
class Sequences:
    """What the policies of a study learn one after another.

    Attributes:
        orders: orders of its tasks.
        together: from backbone, method, R and seed to the name of the policy that learns all tasks
            together.
        scene: what its outcomes have before the name of a task.
        kinds: of `KINDS`.
    """

    orders: Sequence[Sequence[str]]
    together: Callable[[str, str, int, int], str]
    scene: str = ""
    kinds: Collection[str] = tuple(KINDS)

    def of_kind(self, kind: str) -> Sequence[Sequence[str]]:
        """Return the orders in which a kind learns the tasks."""
        return self.orders[: 1 if kind in SINGLE else None]


class Rates(NamedTuple):
    """Success in each task `[..., T]`, or its outcomes `[S, T, N]`, tasks in order of name.

    Attributes:
        base: before the first task is learned.
        before: right before this task is.
        after: right after it.
        end: after the last task.
    """

    base: np.ndarray
    before: np.ndarray
    after: np.ndarray
    end: np.ndarray


Order = Sequence[int]
"""Which of the tasks by name is learned first, second, ..."""
Seeds = Sequence[Mapping[str, Any]]
"""Results of one kind in one order, by seed."""


def at_end(rates: Rates, order: Order) -> np.ndarray:
    """Mean success after the last task."""
    del order
    return rates.end.mean(-1)


def learned(rates: Rates, order: Order) -> np.ndarray:
    """Mean success in each task right after it was learned."""
    del order
    return rates.after.mean(-1)


def last(rates: Rates, order: Order) -> np.ndarray:
    """Success in the last task."""
    return rates.end[..., order[-1]]


def forgotten(rates: Rates, order: Order) -> np.ndarray:
    """Mean fall of success from right after a task was learned to the end; not the last's.

    This is minus the backward transfer. The fall from the best of all later stages would be biased.
    """
    return (rates.after - rates.end)[..., order[:-1]].mean(-1)


def before(rates: Rates, order: Order) -> np.ndarray:
    """Mean success in a task right before it is learned, minus the base's; not the first's."""
    return (rates.before - rates.base)[..., order[1:]].mean(-1)


def table(results: Results, backbone: str, sequences: Sequences) -> str:
    """Return what policies that learn one task after another can do, learn and forget."""
    rows = []
    for method, label in METHODS.items():
        (found,) = ran(results, _together(backbone, method, sequences))
        rate = page.success(_of_all(found, sequences) if found else None)
        row = [rate, *[page.NONE] * 7, str(len(found))]
        rows.append([f"{label}, all tasks together", *row])
    for kind in sequences.kinds:
        row, count = _row(results, backbone, kind, sequences)
        rows.append([KINDS[kind][2], *row, str(count)])
    heads = ["at the end", "minus together", "right after learning", "of these, the last"]
    heads += ["forgotten", "minus", "gained before learning", "directions protected", "seeds"]
    return page.table([f"{BACKBONES[backbone]}, success [%]", *heads], rows)


def _row(results: Results, backbone: str, kind: str, sequences: Sequences) -> tuple[list[str], int]:
    """Return the numbers of a kind, and of how many seeds they are."""
    method, _, _, changed = KINDS[kind]
    own, orders = _policies(backbone, kind, sequences), sequences.orders
    *found, joint = ran(results, *own, _together(backbone, method, sequences))
    if not joint:
        return [page.NONE] * 8, 0
    together = _of_all(joint, sequences)
    if kind in SINGLE:
        after = _outcomes(found[0], {t: f"{k}/{t}" for k, t in enumerate(orders[0], 1)})
        rate, minus = page.success(after), page.difference(after, together)
        return [rate, minus, rate, *[page.NONE] * 5], len(joint)
    rates = [_rates(*pair) for pair in zip(found, orders, strict=True)]
    mean_minus = lambda joint, *ends: np.mean([statistics.minus(x, joint) for x in ends], axis=0)  # noqa: E731
    minus = statistics.bootstrap(mean_minus, together, *(each.end for each in rates))
    row = [page.percent(estimate(at_end, rates, orders)), page.points(minus)]
    row += [page.percent(estimate(statistic, rates, orders)) for statistic in (learned, last)]
    row += [page.points(estimate(forgotten, rates, orders)), page.NONE]
    if changed:
        both = ran(results, *own, *_policies(backbone, changed, sequences))
        if both[0]:
            pairs = [_rates(*pair) for pair in zip(both, [*orders, *orders], strict=True)]
            row[-1] = page.points(estimate(forgotten, pairs, orders))
    shares = [each["protected"][-1] for order in found for each in order if "protected" in each]
    share = f"{100 * np.mean(shares):.0f} %" if shares else page.NONE
    return [*row, page.points(estimate(before, rates, orders)), share], len(joint)


def _policies(backbone: str, kind: str, sequences: Sequences) -> list[list[str]]:
    """Return the names of the policies of a kind by order and seed."""
    orders = range(len(sequences.of_kind(kind)))
    return [[names.sequence(backbone, kind, order, seed) for seed in SEEDS] for order in orders]


def _together(backbone: str, method: str, sequences: Sequences) -> list[str]:
    return [sequences.together(backbone, method, WIDE, seed) for seed in SEEDS]


def _of_all(seeds: Seeds, sequences: Sequences) -> np.ndarray:
    """Return the outcomes of policies that have learned all tasks together."""
    return _outcomes(seeds, {task: sequences.scene + task for task in sequences.orders[0]})


def _rates(seeds: Seeds, order: Sequence[str]) -> Rates:
    """Return the outcomes of policies that have learned tasks in an order."""
    count = len(order)
    stages = [0] * count, range(count), range(1, count + 1), [count] * count
    keys = [{t: f"{k}/{t}" for k, t in zip(stage, order, strict=True)} for stage in stages]
    return Rates(*(_outcomes(seeds, each) for each in keys))


def _outcomes(seeds: Seeds, keys: Mapping[str, str]) -> np.ndarray:
    """Stack some outcomes, bool `[S, T, N]`, given their keys by task."""
    return statistics.stacked([{t: seed["outcomes"][k] for t, k in keys.items()} for seed in seeds])


def _mean_minus(joint: np.ndarray, *ends: np.ndarray) -> np.ndarray:
    return np.mean([statistics.minus(end, joint) for end in ends], axis=0)


def estimate(
    statistic: Callable[[Rates, Order], np.ndarray],
    found: Sequence[Rates],
    orders: Sequence[Sequence[str]],
) -> Estimate:
    """Estimate a statistic, averaged over orders, from the outcomes in each.

    With those of a second kind behind those of the first, estimate the difference.
    """
    numbers = [[sorted(order).index(task) for task in order] for order in orders]
    size = len(Rates._fields)

    def mean(*arrays: np.ndarray) -> np.ndarray:
        each = [Rates(*arrays[i * size : (i + 1) * size]) for i in range(len(found))]
        values = [statistic(x, numbers[i % len(numbers)]) for i, x in enumerate(each)]
        first, second = values[: len(numbers)], values[len(numbers) :]
        return np.mean(first, axis=0) - (np.mean(second, axis=0) if second else 0.0)

    return statistics.bootstrap(mean, *(x for rates in found for x in rates))
