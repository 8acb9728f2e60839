"""The tables of docs/metaworld.md, from the results of all finished policies alone."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lorasp_jax.base.writing import write_text
from lorasp_jax.extras.study import statistics
from lorasp_jax.extras.study.results import rounded
from studies.metaworld.cells import METHODS, SEEDS, Cell, Results
from studies.metaworld.tasks import GROUPS, HELD_OUT
from studies.paper.book import BACKBONES, percent, signed

BEGIN, END = "<!-- begin: studies.metaworld.compare -->\n", "<!-- end -->\n"
"""What the tables stand between."""
LABELS = {
    "lora_sp": "LoRA-SP, R = 64",
    "lora_r64": "LoRA, r = 64",
    "lora_r16": "LoRA, r = 16",
    "ada_lora": "AdaLoRA, 64 cut to a mean of 16",
    "full": "full fine-tuning",
}
TITLES = {
    "mt50": "All fifty tasks, from the base that has only seen a simulated Panda",
    "ml5": "Five tasks, after full fine-tuning on the other 45",
}
Seeds = Sequence[Mapping[str, Any]]
"""Results of one method, by seed."""
Columns = Mapping[str, Sequence[str]]
"""Column of a table -> the tasks that it averages."""


def dumps(results: Results) -> str:
    """Return results as JSON with a line per policy, sorted, and rounded numbers."""
    lines = [
        f"{json.dumps(n)}: {json.dumps(rounded(results[n]), sort_keys=True)}"
        for n in sorted(results)
    ]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def load(path: Path) -> dict[str, Any]:
    """Read results; none, if there is no file yet.

    Raises:
        ValueError: the file is damaged.
    """
    try:
        return json.loads(path.read_text()) if path.exists() else {}
    except ValueError as error:
        raise ValueError(f"{path} is damaged, restore it: {error}") from error


def write(results: Results, path: Path) -> None:
    """Replace the tables in a page.

    Raises:
        ValueError: the page has no place for them.
    """
    text = path.read_text()
    if BEGIN not in text or END not in text.partition(BEGIN)[2]:
        raise ValueError(f"{path} lacks the lines {BEGIN.strip()} and {END.strip()}")
    before, _, rest = text.partition(BEGIN)
    write_text(path, before + BEGIN + tables(results) + END + rest.partition(END)[2])


def tables(results: Results) -> str:
    """Return the tables in Markdown, without those that have no policy yet."""
    parts = []
    for tasks, title in TITLES.items():
        found = [_table(results, name, tasks) for name in BACKBONES if _has(results, name, tasks)]
        parts += [f"### {title}\n", *found] if found else []
    return "\n" + "\n".join(parts or ["No policy has been judged yet.\n"])


def _has(results: Results, backbone: str, tasks: str) -> bool:
    return any(_seeds(results, backbone, tasks, method) for method in METHODS)


def _table(results: Results, backbone: str, tasks: str) -> str:
    """Return the table of a backbone: a row per method, the success on each group or task."""
    groups = {name: tuple(members) for name, members in GROUPS.items()}
    columns = groups if tasks == "mt50" else {task: (task,) for task in HELD_OUT}
    head = [BACKBONES[backbone], "rate", "trained", "active rank", *columns]
    head += ["mean", "minus LoRA-SP"]
    seeds = {method: _seeds(results, backbone, tasks, method) for method in METHODS}
    rows = [_row(LABELS[method], seeds[method], seeds["lora_sp"], columns) for method in METHODS]
    return "".join(f"| {' | '.join(row)} |\n" for row in [head, ["---"] * len(head), *rows])


def _row(label: str, seeds: Seeds, reference: Seeds, columns: Columns) -> list[str]:
    """Return the cells of a method's row; `reference` is LoRA-SP."""
    if len(seeds) < len(SEEDS):
        return [label, *["–"] * (len(columns) + 4), f"{len(seeds)} of {len(SEEDS)} seeds so far"]
    found, order = statistics.outcomes([[cell] for cell in seeds]), sorted(seeds[0]["outcomes"])
    rates = dict(zip(order, found.mean((0, 2)), strict=True))
    means = [np.mean([rates[task] for task in members]) for members in columns.values()]
    difference = "–"
    if len(reference) == len(SEEDS) and reference != seeds:
        other = statistics.outcomes([[cell] for cell in reference])
        value, low, high = (signed(100 * x) for x in statistics.difference(found, other))
        difference = f"{value} [{low}, {high}]"
    facts = [f"{seeds[0]['rate']:g}", f"{100 * seeds[0]['trainable']:.1f} %", _ranks(seeds)]
    success = [f"{100 * mean:.1f}" for mean in means]
    return [label, *facts, *success, percent(statistics.success(found)), difference]


def _seeds(results: Results, backbone: str, tasks: str, method: str) -> Seeds:
    """Return the results of a method's finished seeds."""
    names = [Cell(backbone, tasks, method, seed).name for seed in SEEDS]
    return [results[name] for name in names if name in results]


def _ranks(seeds: Seeds) -> str:
    """Return the mean active ranks of vision, language and action at the end of training."""
    modules = [m for m in ("vision", "language", "action") if m in seeds[0]["active_rank"]]
    means = [np.mean([cell["active_rank"][module] for cell in seeds]) for module in modules]
    return ", ".join(f"{mean:.1f}" for mean in means) or "–"
