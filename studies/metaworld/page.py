"""The tables of README.md, from the results of all policies alone."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lorasp_jax.extras.study import page, statistics
from lorasp_jax.extras.study.page import BACKBONES, NONE
from lorasp_jax.extras.study.study import Results
from studies.metaworld.tasks import GROUPS, HELD_OUT

LABELS = {
    "lora_sp": "LoRA-SP, R = 64",
    "lora_r64": "LoRA, r = 64",
    "lora_r16": "LoRA, r = 16",
    "ada_lora": "AdaLoRA, 64 cut to a mean of 16",
    "full": "full fine-tuning",
}
COLUMNS: Mapping[str, Mapping[str, Sequence[str]]] = {
    "mt50": {name: tuple(members) for name, members in GROUPS.items()},
    "ml5": {task: (task,) for task in HELD_OUT},
}
"""Stage -> column of its table -> the tasks that it averages."""
Seeds = Sequence[Mapping[str, Any]]
"""Results of one method, by seed."""


def blocks(results: Results) -> dict[str, str]:
    """Return the tables of both stages by name."""
    return {
        stage: "\n".join(_table(results, backbone, stage) for backbone in BACKBONES)
        for stage in COLUMNS
    }


def _table(results: Results, backbone: str, stage: str) -> str:
    """Return the table of a backbone: a row per method, the success on each group or task."""
    columns = COLUMNS[stage]
    head = [BACKBONES[backbone], "rate", "trained", "active rank", *columns]
    seeds = {
        method: [r for n, r in results.items() if n.startswith(f"{backbone}/{stage}/{method}/")]
        for method in LABELS
    }
    rows = [_row(LABELS[m], seeds[m], seeds["lora_sp"], columns) for m in LABELS]
    return page.table([*head, "mean", "minus LoRA-SP"], rows)


def _row(
    label: str, seeds: Seeds, reference: Seeds, columns: Mapping[str, Sequence[str]]
) -> list[str]:
    """Return the cells of a method's row; `reference` is LoRA-SP."""
    found, order = statistics.outcomes([[cell] for cell in seeds]), sorted(seeds[0]["outcomes"])
    rates = dict(zip(order, found.mean((0, 2)), strict=True))
    means = [np.mean([rates[task] for task in members]) for members in columns.values()]
    difference = NONE
    if reference is not seeds:
        other = statistics.outcomes([[cell] for cell in reference])
        difference = page.points(statistics.difference(found, other))
    trained = seeds[0]["trainable_parameters"] / seeds[0]["total_parameters"]
    rate = seeds[0]["config"]["optim"]["learning_rate"]
    facts = [f"{rate:g}", f"{100 * trained:.1f} %", _ranks(seeds)]
    success = [f"{100 * mean:.1f}" for mean in means]
    return [label, *facts, *success, page.percent(statistics.success(found)), difference]


def _ranks(seeds: Seeds) -> str:
    """Return the mean active ranks of vision, language and action at the end of training."""
    modules = [m for m in ("vision", "language", "action") if m in seeds[0]["active_rank"]]
    means = [np.mean([cell["active_rank"][module] for cell in seeds]) for module in modules]
    return ", ".join(f"{mean:.1f}" for mean in means) or NONE
