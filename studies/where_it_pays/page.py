"""The tables and the figure of README.md, from the results of all policies alone."""

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from lorasp_jax.evaluation.figure_style import STYLE
from lorasp_jax.extras.study import Study, page, statistics
from lorasp_jax.extras.study import figure as figures
from lorasp_jax.extras.study.page import BACKBONES
from lorasp_jax.extras.study.results import ran, rate_of
from lorasp_jax.extras.study.study import Results
from studies.few.page import SCENES, outcomes
from studies.where_it_pays import names, sequence_page
from studies.where_it_pays.names import METHODS, SEEDS, WIDE, cell

COLORS = {"lora": "#4269d0", "lora_sp": "#ff725c"}
RANKS = (4, 8, 16, 32, 64, 128)
BUDGETS = (8, 16, 32)
"""Mean ranks of plans and their rivals."""
PARAMETERS = (0.3, 1, 3, 10)
"""Ticks of the figure [M]."""
HALF = "lora_sp_half"
"""LoRA-SP that learns the first half of the tasks."""
BASE_ROWS = {
    "first": {"lora": "LoRA, r = 64", "lora_sp": "LoRA-SP, R = 64"},
    "second": {"lora": "LoRA, r = 64", "lora_sp": "LoRA-SP, R = 64"},
    "medium": {
        "lora": "LoRA, r = 32",
        "lora_sp": "LoRA-SP, R = 32",
        "ada_lora": "AdaLoRA, 32 cut to a mean of 8",
        "full": "full fine-tuning",
    },
}
"""Base -> method -> label; see `bases.BASES`."""
ALLOCATED = {
    "ranks in proportion to LoRA-SP's active ranks": ("planned", "lora"),
    "the same, shuffled over layers of one size": ("shuffled", "lora"),
    "the former minus the latter": ("planned", "shuffled"),
    "ranks of another seed, minus own": ("other_seed", "planned"),
    "ranks of a policy that learned two of the tasks, minus own": ("other_tasks", "planned"),
    "ranks of the other backbone, by kind of layer, minus own": ("other_backbone", "planned"),
    "one rank, EVA's initialization": ("eva", "lora"),
    "AdaLoRA": ("ada_lora", "lora"),
    "LoRA with r = 64, cut by one threshold on singular values": ("cut", "lora"),
    "the same, trained on for 400 steps": ("cut_healed", "lora"),
    "ranks in proportion to active ranks, minus that": ("planned", "cut_healed"),
    "the layers with the lowest active rank dropped, half of the parameters": ("dropped", "lora"),
    "the same, minus random layers dropped": ("dropped", "dropped_random"),
}
"""Label -> two methods whose success is compared; "lora" has one rank for all layers."""

FORMS = {
    "whole": ("lora_sp", "whole"),
    "half": ("lora_sp", "half of the bank"),
    "merged": ("lora_sp", "one LoRA, merged"),
    "merged_int8": ("lora_sp", "the same, base in int8"),
    "taught": ("lora_sp", "one LoRA, merged, taught by the whole policy"),
    "by_task": ("lora_sp", "one LoRA per task, merged"),
    "lora": ("lora", "plain LoRA, merged"),
}
"""Form of a policy with R = `WIDE` -> its method, and its label; see docs/deployment.md."""
HEAL = 400
"""Steps by which forms train on."""
HEALED = ("taught", "merged_int8")
"""Forms that are judged only after training on."""
MADE = ("by_task",)
"""Forms that are judged only as made."""
_MINUS = ("", ", minus whole", ", minus merged")

RECIPES = {
    "lora_sp": "LoRA-SP, R = 64",
    "eta_0.8": "η = .8",
    "eta_0.99": "η = .99",
    "relu": "ReLU scores",
    "softmax": "softmax scores",
    "spectral_0": "no spectral loss",
    "spectral_0.1": "spectral loss x 10",
    "balance_0": "no balance loss",
    "z_0.01": "z loss x 10, which pulls scores to 1",
    "scale_1": "α = R",
    "scale_4": "α = 4 R",
    "eva": "V begin as EVA's",
    "pissa": "V begin as PiSSA's",
    "eta_vlm": "η = .8 in the action expert, .99 elsewhere",
    "eta_expert": "η = .99 in the action expert, .8 elsewhere",
    "chunk": "all actions of a chunk share their scores",
    "expert": "LoRA on vision and language",
    "vlm": "LoRA on the action expert",
}
"""Changes of LoRA-SP that pilots try."""
RECIPE_SEEDS = (1001, 1002, 1003)

_ORDER = ("press", "open_pot", "pick_place", "pour")
_KINDS = [kind for kind in sequence_page.KINDS if kind != "single"]
SEQUENCES = sequence_page.Sequences((_ORDER, _ORDER[::-1]), cell, "recorded/", _KINDS)


def blocks(_: Study, results: Results, folder: Path) -> dict[str, str]:
    """Write the figure into `folder`; return the tables, with the seeds that have run."""
    _figure(results, folder / "ranks.svg")
    tables = {
        "ranks": _rank_table,
        "layers": _layer_table,
        "forms": _form_table,
        "sequences": functools.partial(sequence_page.table, sequences=SEQUENCES),
        "bases": _base_table,
    }
    made = {f"{b} {name}": table(results, b) for name, table in tables.items() for b in BACKBONES}
    more = {"pilots": _pilot_table, "contrasts": _contrast_table, "recipes": _recipe_table}
    return made | {name: table(results) for name, table in more.items()}


def _rank_table(results: Results, backbone: str) -> str:
    """Return success by rank, LoRA-SP's minus LoRA's, and the parameters of both."""
    rows = []
    for rank in RANKS:
        row = [str(rank)]
        both = _pair(results, backbone, ("lora_sp", rank), ("lora", rank))
        for scene in SCENES:
            own, lora = (_outcomes(found, scene) for found in both)
            row += [page.success(lora), page.success(own), page.difference(own, lora)]
        for found in reversed(both):
            count = found[0]["trainable_parameters"] / 1e6 if found else 0
            row.append(f"{count:.2f} M" if found else page.NONE)
        rows.append([*row, str(len(both[0]))])
    heads = [
        f"{m}, {scene}" for scene in SCENES.values() for m in (*METHODS.values(), "difference")
    ]
    parameters = [f"{label}'s parameters" for label in METHODS.values()]
    return page.table([f"{BACKBONES[backbone]}: R", *heads, *parameters, "seeds"], rows)


def _pilot_table(results: Results) -> str:
    """Return the success of pilots by rate, as recorded."""
    cases = [(b, method) for b in BACKBONES for method in METHODS]
    rows = []
    for rank in RANKS:
        row = [str(rank)]
        for case in cases:
            tried = {rate_of(x): results[x] for x in names.pilots(*case, rank) if x in results}
            rates = {r: outcomes([x], "recorded").mean() for r, x in tried.items()}
            row.append(", ".join(f"{100 * x:.1f} ({r:g})" for r, x in rates.items()) or page.NONE)
        rows.append(row)
    heads = [f"{BACKBONES[b]}, {METHODS[method]}" for b, method in cases]
    return page.table(["R", *heads], rows)


def _contrast_table(results: Results) -> str:
    """Return what claims compare and no other table has, as recorded."""
    each = [_contrasts(backbone) for backbone in BACKBONES]
    rows = [[label] for label in each[0]]
    for contrasts in each:
        for row, (statistic, policies) in zip(rows, contrasts.values(), strict=True):
            found = ran(results, *policies)
            stacked = [outcomes(x, "recorded") for x in found if x]
            row.append(
                page.points(statistics.bootstrap(statistic, *stacked)) if stacked else page.NONE
            )
    return page.table(["points", *BACKBONES.values()], rows)


def _contrasts(backbone: str) -> dict[str, tuple[Callable[..., Any], list[list[str]]]]:
    """Return statistics by label, and the names by seed of the policies that they compare."""
    both = "lora_sp", "lora"
    own, lora = ({r: [cell(backbone, m, r, s) for s in SEEDS] for r in RANKS} for m in both)
    on = [_policies_on(backbone, kind, m) for kind in ("second", "first") for m in both]
    wide, lora_wide = ([by_rank[r] for r in RANKS if r >= 16] for by_rank in (own, lora))
    return {
        "LoRA, highest minus lowest success, R = 16 to 128": (statistics.span, lora_wide),
        "LoRA-SP, the same": (statistics.span, wide),
        "the latter minus the former": (statistics.span_minus, [*wide, *lora_wide]),
        "LoRA-SP, R = 16, minus LoRA, r = 32, which has as many parameters": (
            statistics.minus,
            [own[16], lora[32]],
        ),
        "LoRA-SP minus LoRA, R = 64, on the second base, minus that on the first": (
            statistics.interaction,
            on,
        ),
    }


def _layer_table(results: Results, backbone: str) -> str:
    """Return differences of success as recorded between ways to give layers their ranks."""
    rows = []
    for label, methods in ALLOCATED.items():
        pairs = [_pair(results, backbone, *((x, rank) for x in methods)) for rank in BUDGETS]
        rows.append([label, *(_difference(both, "recorded") for both in pairs)])
    heads = [f"mean r = {rank}" for rank in BUDGETS]
    return page.table([f"{BACKBONES[backbone]}, points", *heads], rows)


def _form_table(results: Results, backbone: str) -> str:
    """Return success of forms as made and trained on, also minus the whole policy's, and sizes."""
    rows = []
    for name, (_, label) in FORMS.items():
        row, size, count = [label], page.NONE, 0
        for healed in (False, True):
            (own,) = ran(results, _formed(backbone, name, healed))
            row.append(page.success(_outcomes(own, "recorded")))
            for other in ("whole", "merged"):
                both = ran(results, *(_formed(backbone, x, healed) for x in (name, other)))
                row.append(page.NONE if name == other else _difference(both, "recorded"))
        if own:
            size, count = f"{own[0]['bytes'] / 1e6:.1f} MB", len(own)
        rows.append([*row, size, str(count)])
    heads = [f"{when}{head}" for when in ("as made", f"after {HEAL} steps") for head in _MINUS]
    heads += ["weights", "seeds"]
    return page.table([BACKBONES[backbone], *heads], rows)


def _formed(backbone: str, name: str, healed: bool) -> list[str]:
    """Return the names of a form's policies by seed."""
    return [names.form(backbone, name, healed, seed) for seed in SEEDS]


def _base_table(results: Results, backbone: str) -> str:
    """Return success on three bases, also minus LoRA's."""
    rows = []
    for kind, methods in BASE_ROWS.items():
        if base := results.get(names.base(backbone, kind)):
            rate = page.success(statistics.stacked([base["outcomes"]]))
            rows.append([kind, "the base itself, on the Panda", rate, *[page.NONE] * 3, "1"])
        for method, label in methods.items():
            both = ran(results, *(_policies_on(backbone, kind, x) for x in (method, "lora")))
            row = [kind, label]
            for scene in SCENES:
                row += _compared(both, scene, itself=method == "lora")
            rows.append([*row, str(len(both[0]))])
    heads = [f"{scene}{head}" for scene in SCENES.values() for head in ("", ", minus LoRA")]
    return page.table([f"{BACKBONES[backbone]}: base", "method", *heads, "seeds"], rows)


def _policies_on(backbone: str, kind: str, method: str) -> list[str]:
    """Return the names of the policies of a method on a base."""
    if kind == "first":
        return [cell(backbone, method, WIDE, seed) for seed in SEEDS]
    return [names.on_base(backbone, kind, method, f"s{seed}") for seed in SEEDS]


def _recipe_table(results: Results) -> str:
    """Return success of changed LoRA-SP, also minus that of LoRA-SP as it is."""
    rows = []
    for name, label in RECIPES.items():
        row = [label]
        for backbone in BACKBONES:
            policies = [
                [names.recipe(backbone, x, seed) for seed in RECIPE_SEEDS]
                for x in (name, "lora_sp")
            ]
            both = ran(results, *policies)
            for scene in SCENES:
                row += _compared(both, scene, itself=name == "lora_sp")
            row.append(str(len(both[0])))
        rows.append(row)
    scenes = [f"{x}{head}" for x in SCENES.values() for head in ("", ", minus LoRA-SP")]
    heads = [f"{label}, {head}" for label in BACKBONES.values() for head in (*scenes, "seeds")]
    return page.table(["pilots", *heads], rows)


def _compared(
    both: Sequence[Sequence[Mapping[str, Any]]], scene: str, *, itself: bool = False
) -> list[str]:
    """Return success of the first of two methods, and that minus the second's, unless `itself`."""
    minus = page.NONE if itself else _difference(both, scene)
    return [page.success(_outcomes(both[0], scene)), minus]


def _difference(both: Sequence[Sequence[Mapping[str, Any]]], scene: str) -> str:
    return page.difference(*(_outcomes(found, scene) for found in both))


def _outcomes(found: Sequence[Mapping[str, Any]], scene: str) -> np.ndarray | None:
    return outcomes(found, scene) if found else None


def _pair(
    results: Results, backbone: str, *cases: tuple[str, int]
) -> list[list[Mapping[str, Any]]]:
    """Return the results of two methods for the seeds that have run with both."""
    return ran(results, *([cell(backbone, *case, seed) for seed in SEEDS] for case in cases))


@mpl.rc_context(STYLE)
def _figure(results: Results, path: Path) -> None:
    """Draw success by rank and by parameters, a row per backbone."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots(len(BACKBONES), 2, sharey=True)
    for row, (backbone, label) in zip(axes, BACKBONES.items(), strict=True):
        for method, name in METHODS.items():
            found = {rank: _pair(results, backbone, (method, rank))[0] for rank in RANKS}
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
