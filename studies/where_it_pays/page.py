"""The tables and the figure of README.md, from the results of all policies alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from lorasp_jax.evaluation.figure_style import STYLE
from lorasp_jax.extras.study import Study, page, statistics
from lorasp_jax.extras.study import figure as figures
from lorasp_jax.extras.study.page import BACKBONES
from lorasp_jax.extras.study.study import Results
from studies.few.page import SCENES, outcomes

METHODS = {"lora": "LoRA", "lora_sp": "LoRA-SP"}
COLORS = {"lora": "#4269d0", "lora_sp": "#ff725c"}
RANKS = (4, 8, 16, 32, 64, 128)
WIDE = 64
"""R of the policies whose ranks by layer plans have, and that are cut."""
BUDGETS = (8, 16, 32)
"""Mean ranks of plans and their rivals."""
PARAMETERS = (0.3, 1, 3, 10)
"""Ticks of the figure [M]."""
SEEDS = (0, 1, 2)
ALLOCATED = {
    "planned": "ranks in proportion to LoRA-SP's active ranks",
    "other_seed": "the same, of another seed",
    "shuffled": "the same, shuffled over layers of one size",
    "eva": "one rank, EVA's initialization",
    "ada_lora": "AdaLoRA",
    "cut": "LoRA with r = 64, cut by one threshold on singular values",
    "dropped": "the layers with the lowest active rank dropped, half of the parameters",
    "dropped_random": "random layers dropped, half of the parameters",
}
"""What is compared with LoRA of one rank for all layers."""


def cell(backbone: str, method: str, rank: int, seed: int) -> str:
    """Return the name of a policy."""
    return f"{backbone}/{method}/r{rank}/s{seed}"


def blocks(_: Study, results: Results, folder: Path) -> dict[str, str]:
    """Write the figure into `folder`; return the tables, with the seeds that have run."""
    _figure(results, folder / "ranks.svg")
    made = {f"{backbone} ranks": _rank_table(results, backbone) for backbone in BACKBONES}
    made |= {f"{backbone} layers": _layer_table(results, backbone) for backbone in BACKBONES}
    return made


def _rank_table(results: Results, backbone: str) -> str:
    """Return success by rank, LoRA-SP's minus LoRA's, and the parameters of both."""
    rows = []
    for rank in RANKS:
        row = [str(rank)]
        both = _pair(results, backbone, ("lora_sp", rank), ("lora", rank))
        for scene in SCENES:
            stacked = [outcomes(found, scene) for found in both] if both[0] else []
            row += [page.percent(statistics.success(x)) for x in reversed(stacked)]
            row += [page.points(statistics.difference(*stacked))] if stacked else []
            row += [page.NONE] * (0 if stacked else 3)
        for found in reversed(both):
            count = found[0]["trainable_parameters"] / 1e6 if found else 0
            row.append(f"{count:.2f} M" if found else page.NONE)
        rows.append([*row, str(len(both[0]))])
    heads = [
        f"{m}, {scene}" for scene in SCENES.values() for m in (*METHODS.values(), "difference")
    ]
    parameters = [f"{label}'s parameters" for label in METHODS.values()]
    return page.table([f"{BACKBONES[backbone]}: R", *heads, *parameters, "seeds"], rows)


def _layer_table(results: Results, backbone: str) -> str:
    """Return success as recorded of LoRA with ranks by layer minus that of one rank."""
    rows = []
    for method, label in ALLOCATED.items():
        row = [label]
        for rank in BUDGETS:
            both = _pair(results, backbone, (method, rank), ("lora", rank))
            stacked = [outcomes(found, "recorded") for found in both] if both[0] else []
            row.append(page.points(statistics.difference(*stacked)) if stacked else page.NONE)
        rows.append(row)
    heads = [f"mean r = {rank}" for rank in BUDGETS]
    return page.table([f"{BACKBONES[backbone]}, points over one rank", *heads], rows)


def _pair(
    results: Results, backbone: str, *cases: tuple[str, int]
) -> list[list[Mapping[str, Any]]]:
    """Return the results of two methods for the seeds that have run with both."""
    names = [[cell(backbone, *case, seed) for case in cases] for seed in SEEDS]
    ran = [[results[name] for name in pair] for pair in names if all(n in results for n in pair)]
    return [list(column) for column in zip(*ran, strict=True)] or [[] for _ in cases]


@mpl.rc_context(STYLE)
def _figure(results: Results, path: Path) -> None:
    """Draw success by rank and by parameters, a row per backbone."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots(len(BACKBONES), 2, sharey=True)
    for row, (backbone, label) in zip(axes, BACKBONES.items(), strict=True):
        for method, name in METHODS.items():
            found = {rank: _ran(results, backbone, method, rank) for rank in RANKS}
            if not (found := {rank: each for rank, each in found.items() if each}):
                continue
            rates = [statistics.success(outcomes(each, "recorded")) for each in found.values()]
            counts = [each[0]["trainable_parameters"] / 1e6 for each in found.values()]
            for axis, at in zip(row, ([*found], counts), strict=True):
                figures.panel(axis, at, {name: (COLORS[method], rates)})
        row[0].set_title(label, loc="left")
        row[0].set_xticks(RANKS, [str(rank) for rank in RANKS])
        row[1].set_xticks(PARAMETERS, [str(count) for count in PARAMETERS])
        row[0].set_ylabel("success [%]")
    axes[-1, 0].set_xlabel("R")
    axes[-1, 1].set_xlabel("trained parameters [M]")
    figures.write(figure, path, "where_it_pays")


def _ran(results: Results, backbone: str, method: str, rank: int) -> list[Mapping[str, Any]]:
    names = [cell(backbone, method, rank, seed) for seed in SEEDS]
    return [results[name] for name in names if name in results]
