"""The tables of README.md, from the results of all policies alone."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from lorasp_jax.extras.study import page, statistics
from lorasp_jax.extras.study.page import BACKBONES, NONE
from lorasp_jax.extras.study.study import Results
from studies.metaworld.tasks import FIRST, GROUPS, HELD_OUT, SETS
from studies.where_it_pays import sequence_page
from studies.where_it_pays.names import WIDE

LABELS = {
    "lora_sp": "LoRA-SP, R = 64",
    "lora_r64": "LoRA, r = 64",
    "lora_r16": "LoRA, r = 16",
    "ada_lora": "AdaLoRA, 64 cut to a mean of 16",
    "full": "full fine-tuning",
}
GROWING = ("lora_r16", "lora_r64", "lora_sp")
"""Methods that learn sets of every size, LoRA-SP and the LoRA of its size last."""
SHARED = GROWING[1:]
"""Those of them that learn single tasks, too."""
RANKS = {
    rank: (f"lora_r{rank}", "lora_sp" if rank == 64 else f"lora_sp_r{rank}")
    for rank in (4, 8, 16, 32, 64, 128)
}
"""R -> LoRA and LoRA-SP."""
UNTUNED = 16
"""R whose policies take the rate of R = 64; all others have pilots."""
SEEDS = (0, 1, 2)
SIZES = (*(f"first{size}" for size in FIRST), "mt50")
"""Sets of tasks that contain each other."""
COLUMNS: Mapping[str, Mapping[str, Sequence[str]]] = {
    "mt50": {name: tuple(members) for name, members in GROUPS.items()},
    "ml5": {task: (task,) for task in HELD_OUT},
}
"""Stage -> column of its table -> the tasks that it averages."""
TOGETHER = {"lora": "lora_r64", "lora_sp": "lora_sp"}
"""Method of `sequence_page.KINDS` -> its name here."""
Case = tuple[Sequence[str], str]
"""Stages that together have all tasks, and a method."""
Seeds = Sequence[Mapping[str, Any]]
"""Results of one method, by seed."""


def together(backbone: str, method: str, rank: int, seed: int) -> str:
    """Return the name of the policy that learns the tasks of a sequence together."""
    assert rank == WIDE
    return f"{backbone}/together/{TOGETHER[method]}/s{seed}"


_LEARNED = SETS["first10"]
_KINDS = [kind for kind, (_, rank, *_) in sequence_page.KINDS.items() if rank == WIDE]
SEQUENCES = sequence_page.Sequences((_LEARNED, _LEARNED[::-1]), together, kinds=_KINDS)


def blocks(results: Results) -> dict[str, str]:
    """Return all tables by name, with a dash for what has not run."""
    tables: dict[str, Callable[[Results, str], str]] = {
        **{stage: functools.partial(_table, stage=stage) for stage in COLUMNS},
        "sizes": _size_table,
        "shared": _shared_table,
        "ranks": _rank_table,
        "sequences": functools.partial(sequence_page.table, sequences=SEQUENCES),
    }
    return {
        name: "\n".join(table(results, backbone) for backbone in BACKBONES)
        for name, table in tables.items()
    }


def _table(results: Results, backbone: str, stage: str) -> str:
    """Return the table of a backbone: a row per method, the success on each group or task."""
    columns = COLUMNS[stage]
    head = [BACKBONES[backbone], "rate", "trained", "active rank", *columns]
    seeds = {
        method: [r for n, r in results.items() if n.startswith(f"{backbone}/{stage}/{method}/")]
        for method in LABELS
    }
    head += ["mean", "minus LoRA-SP"]
    if any(len(ran) < len(SEEDS) for ran in seeds.values()):
        return page.table(head, [[label] for label in LABELS.values()])
    return page.table(head, [_row(LABELS[m], seeds[m], seeds["lora_sp"], columns) for m in LABELS])


def _row(
    label: str, seeds: Seeds, reference: Seeds, columns: Mapping[str, Sequence[str]]
) -> list[str]:
    """Return the cells of a method's row; `reference` is LoRA-SP."""
    found, order = _stacked(seeds), sorted(seeds[0]["outcomes"])
    rates = dict(zip(order, found.mean((0, 2)), strict=True))
    means = [np.mean([rates[task] for task in members]) for members in columns.values()]
    difference = NONE if reference is seeds else page.difference(found, _stacked(reference))
    trained = seeds[0]["trainable_parameters"] / seeds[0]["total_parameters"]
    rate = seeds[0]["config"]["optim"]["learning_rate"]
    facts = [f"{rate:g}", f"{100 * trained:.1f} %", _ranks(seeds)]
    success = [f"{100 * mean:.1f}" for mean in means]
    return [label, *facts, *success, page.success(found), difference]


def _ranks(seeds: Seeds) -> str:
    """Return the mean active ranks of vision, language and action at the end of training."""
    modules = [m for m in ("vision", "language", "action") if m in seeds[0]["active_rank"]]
    means = [np.mean([cell["active_rank"][module] for cell in seeds]) for module in modules]
    return ", ".join(f"{mean:.1f}" for mean in means) or NONE


def _size_table(results: Results, backbone: str) -> str:
    """Return success on all tasks of a policy, and LoRA-SP's lead, by their number."""
    head = [f"{BACKBONES[backbone]}: tasks", *(LABELS[method] for method in GROWING)]
    head += ["lead over r = 16", "lead over r = 64", "the latter, minus that with 5"]
    rows, leads = [], {}
    for stage in SIZES:
        row = [str(len(SETS[stage]))]
        if found := _outcomes(results, backbone, [((stage,), m) for m in GROWING], SETS[stage]):
            *others, own = found
            row += map(page.success, found)
            row += [page.difference(own, other) for other in others]
            leads[stage] = statistics.draw(statistics.minus, (own, others[-1]))
            if SIZES[0] in leads and stage != SIZES[0]:
                (value, draws), (first, first_draws) = leads[stage], leads[SIZES[0]]
                ends = statistics.percentiles(draws - first_draws)
                row.append(page.points(statistics.Estimate(value - first, *ends)))
        rows.append(row)
    return page.table(head, rows)


def _shared_table(results: Results, backbone: str) -> str:
    """Return success on the tasks of the smallest set by the number of tasks that a policy learns.

    Then that minus the success of one policy per task. Policies of `together` have as many steps a
    task as those, the others fewer.
    """
    head = [f"{BACKBONES[backbone]}: tasks", *(LABELS[method] for method in SHARED)]
    head += [f"{LABELS[method]}, minus alone" for method in SHARED]
    head += ["LoRA-SP's minus r = 64's"]
    shared, rows = SETS[SIZES[0]], []
    alone = tuple(f"single-{task}" for task in shared)
    cases = {"1": alone, "10, as many steps a task": ("together",)}
    cases |= {str(len(SETS[stage])): (stage,) for stage in SIZES}
    for label, stages in cases.items():
        row, own = [label], [(stages, method) for method in SHARED]
        if found := _outcomes(results, backbone, own, shared):
            row += map(page.success, found)
        both = [*own, *((alone, method) for method in SHARED)]
        if stages != alone and (found := _outcomes(results, backbone, both, shared)):
            pairs = [*zip(found[: len(own)], found[len(own) :], strict=True)]
            row += [page.difference(*pair) for pair in pairs]
            row.append(
                page.points(statistics.bootstrap(statistics.interaction, *pairs[-1], *pairs[-2]))
            )
        rows.append(row)
    return page.table(head, rows)


def _rank_table(results: Results, backbone: str) -> str:
    """Return success on the fifty tasks by R, and its span over all R with rates of their own."""
    head = [f"{BACKBONES[backbone]}: R", "LoRA", "LoRA-SP", "LoRA-SP minus LoRA"]
    head += ["LoRA's rate", "LoRA-SP's rate"]
    rows, every = [], []
    for rank, pair in RANKS.items():
        ran = [_outcomes(results, backbone, [(("mt50",), method)], SETS["mt50"]) for method in pair]
        row = [page.success(*found) if found else NONE for found in ran]
        lora, own = ran
        row.append(page.difference(*own, *lora) if lora and own else NONE)
        rates = [_rate(results, f"{backbone}/mt50/{method}/s{SEEDS[0]}") for method in pair]
        rows.append([str(rank), *row, *rates])
        if rank != UNTUNED:
            every.append([*lora, *own])
    row = [f"highest minus lowest, without {UNTUNED}"]
    if all(len(both) == 2 for both in every):
        loras, owns = zip(*every, strict=True)
        spans = [statistics.bootstrap(statistics.span, *each) for each in (loras, owns)]
        row += map(page.percent, spans)
        row.append(page.points(statistics.bootstrap(statistics.span_minus, *owns, *loras)))
    return page.table(head, [*rows, row])


def _rate(results: Results, name: str) -> str:
    return f"{results[name]['config']['optim']['learning_rate']:g}" if name in results else NONE


def _outcomes(
    results: Results, backbone: str, cases: Sequence[Case], tasks: Sequence[str]
) -> list[np.ndarray]:
    """Return the outcomes `[S, T, N]` of some policies on some tasks, on their common layouts.

    [] unless all seeds of all of them have run.
    """
    names = [
        [[f"{backbone}/{stage}/{method}/s{seed}" for stage in stages] for seed in SEEDS]
        for stages, method in cases
    ]
    if any(name not in results for case in names for seed in case for name in seed):
        return []
    found = [
        statistics.outcomes([[_only(results[name], tasks) for name in seed] for seed in case])
        for case in names
    ]
    layouts = min(each.shape[2] for each in found)
    return [each[..., :layouts] for each in found]


def _only(cell: Mapping[str, Any], tasks: Sequence[str]) -> Mapping[str, Any]:
    return {
        "outcomes": {task: cell["outcomes"][task] for task in tasks if task in cell["outcomes"]}
    }


def _stacked(seeds: Seeds) -> np.ndarray:
    return statistics.stacked([seed["outcomes"] for seed in seeds])
