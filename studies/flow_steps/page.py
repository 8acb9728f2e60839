"""The tables and the figure of README.md, from the results of all policies alone."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from lorasp_jax.evaluation.figure_style import STYLE
from lorasp_jax.extras.study import Study, page, statistics
from lorasp_jax.extras.study import figure as figures
from lorasp_jax.extras.study.page import BACKBONES
from lorasp_jax.extras.study.statistics import Estimate
from lorasp_jax.extras.study.study import Results

POLICIES = {
    "lora": "LoRA, r = 64",
    "lora_sp": "LoRA-SP, R = 64",
    "noisy": "LoRA-SP, times near noise",
    "rtc": "LoRA-SP, 4 control steps late",
}
DISTILLED = {
    "distilled_1": ("LoRA-SP, distilled to n = 1", 1),
    "distilled_2": ("LoRA-SP, distilled to n = 2", 2),
    "snapflow": ("LoRA-SP, SnapFlow", 1),
}
"""Policies made from those of LoRA-SP, each judged with one number of steps."""
STEPS = (1, 2, 3, 5, 10)
"""Euler steps."""
TWO_WAYS = "two_baskets"
TASKS = ("open_pot", "pour", "press", "pick_place", TWO_WAYS)
SEEDS = (0, 1, 2)
DELAY = 4
"""Delay of the policies that are trained for one [control steps]."""
COLORS = {"lora": "#4269d0", "lora_sp": "#ff725c", "noisy": "#3ca951", "rtc": "#9498a0"}


def blocks(_: Study, results: Results, folder: Path) -> dict[str, str]:
    """Write the figure into `folder`; return the tables."""
    backbones = [
        b for b in BACKBONES if all(f"{b}/{p}/s{s}" in results for p in POLICIES for s in SEEDS)
    ]
    if backbones:
        _figure(results, backbones, folder / "success.svg")
    made = {}
    for backbone in backbones:
        made[f"{backbone} success"] = _table(results, backbone, _success)
        made[f"{backbone} tasks"] = _task_table(results, backbone)
        made[f"{backbone} jerk"] = _table(results, backbone, _jerk)
        made[f"{backbone} spread"] = _table(results, backbone, _spread)
    return made


def outcomes(
    results: Results, backbone: str, policy: str, steps: int, tasks: Sequence[str]
) -> np.ndarray:
    """Stack the episodes of a policy's seeds, bool `[S, T, N]`."""
    found = [results[f"{backbone}/{policy}/s{seed}"]["outcomes"] for seed in SEEDS]
    return statistics.stacked([{t: each[f"{steps}/{t}"] for t in tasks} for each in found])


def _estimate(results: Results, backbone: str, policy: str, steps: int, tasks: Any) -> Estimate:
    return statistics.success(outcomes(results, backbone, policy, steps, tasks))


def _success(*where: Any) -> str:
    return page.success(outcomes(*where))


def _jerk(results: Results, *where: Any) -> str:
    return f"{_mean(results, 'jerk', *where):.0f}"


def _spread(results: Results, *where: Any) -> str:
    return f"{_mean(results, 'spread', *where):.3f}"


def _mean(
    results: Results, name: str, backbone: str, policy: str, steps: int, tasks: Sequence[str]
) -> float:
    found = [results[f"{backbone}/{policy}/s{seed}"][name] for seed in SEEDS]
    return float(np.mean([each[f"{steps}/{task}"] for each in found for task in tasks]))


def _table(results: Results, backbone: str, show: Any) -> str:
    """Return a table with a row per policy and kind of task, and a column per number of steps."""
    policies = {policy: (label, STEPS) for policy, label in POLICIES.items()}
    policies |= {
        policy: (label, (n,))
        for policy, (label, n) in DISTILLED.items()
        if all(f"{backbone}/{policy}/s{seed}" in results for seed in SEEDS)
    }
    rows = [
        [
            label,
            title,
            *(show(results, backbone, name, n, tasks) if n in judged else page.NONE for n in STEPS),
        ]
        for title, tasks in (("four tasks", TASKS[:4]), ("two baskets", TASKS[4:]))
        for name, (label, judged) in policies.items()
    ]
    return page.table([BACKBONES[backbone], "tasks", *(f"n = {n}" for n in STEPS)], rows)


def _task_table(results: Results, backbone: str) -> str:
    """Return the difference to ten steps in success of LoRA-SP, by task, over paired episodes."""
    rows = []
    for task in TASKS:
        most = outcomes(results, backbone, "lora_sp", STEPS[-1], [task])
        cells = []
        for n in STEPS[:-1]:
            fewer = outcomes(results, backbone, "lora_sp", n, [task])
            cells.append(page.difference(fewer, most))
        rows.append([task, *cells, f"{100 * most.mean():.1f}"])
    head = [f"{BACKBONES[backbone]}, LoRA-SP", *(f"n = {n}" for n in STEPS[:-1])]
    return page.table([*head, f"success at n = {STEPS[-1]} [%]"], rows)


@mpl.rc_context(STYLE)
def _figure(results: Results, backbones: Sequence[str], path: Path) -> None:
    """Draw success against the number of steps: a panel per backbone and kind of task."""
    panels = [
        (backbone, title, tasks)
        for backbone in backbones
        for title, tasks in (("four tasks", TASKS[:4]), ("two baskets", TASKS[4:]))
    ]
    figure = Figure(figsize=(1 + 3.2 * len(panels), 2.9), layout="constrained")
    axes = figure.subplots(1, len(panels), sharey=True)
    for axis, (backbone, title, tasks) in zip(axes, panels, strict=True):
        curves = {
            label: (COLORS[name], [_estimate(results, backbone, name, n, tasks) for n in STEPS])
            for name, label in POLICIES.items()
        }
        figures.panel(axis, STEPS, curves)
        axis.set_title(f"{BACKBONES[backbone]}, {title}", loc="left")
        axis.set_xlabel("flow steps")
    axes[0].set_ylabel("success [%]")
    figures.write(figure, path, "flow_steps")
