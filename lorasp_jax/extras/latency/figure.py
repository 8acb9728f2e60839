"""Figure of success and smoothness against delay."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from lorasp_jax.base.writing import atomic_file
from lorasp_jax.evaluation.figure_style import STYLE
from lorasp_jax.evaluation.intervals import wilson_interval

COLORS = {
    "synchronous": "#9498a0",
    "naive": "#efb118",
    "trained": "#4269d0",
    "guided": "#3ca951",
}
ROWS = {
    "success": "success [%]",
    "action_delta": "action delta [rad]",
    "jerk": "jerk [rad/s³]",
}


@mpl.rc_context(STYLE)
def write(path: Path, runs: Sequence[tuple[str, dict[str, Any]]]) -> None:
    """Draw success and smoothness, averaged over tasks, and write them as SVG.

    Args:
        path: file to write.
        runs: name and content of latency.json of each run, which gets one column.
    """
    figure = Figure(figsize=(1.2 + 3.4 * len(runs), 6.4), layout="constrained")
    axes = figure.subplots(len(ROWS), len(runs), sharex="col", sharey="row", squeeze=False)
    entries: dict[str, Any] = {}
    for column, (name, found) in enumerate(runs):
        axes[0, column].set_title(name, loc="left")
        axes[-1, column].set_xlabel(f"delay [control steps of {1e3 * found['control_dt']:g} ms]")
        for execution, color in COLORS.items():
            points = average(found["curves"], execution)
            for row, field in enumerate(ROWS):
                _line(axes[row, column], points, field, execution, color)
        lines, labels = axes[0, column].get_legend_handles_labels()
        entries |= dict(zip(labels, lines, strict=True))
    for row, label in enumerate(ROWS.values()):
        axes[row, 0].set_ylabel(label)
        axes[row, 0].set_ylim(bottom=0)
    columns = 3 if len(runs) == 1 else len(COLORS)
    options: Any = {"loc": "outside upper center", "ncols": columns, "frameon": False}
    figure.legend([*entries.values()], [*entries], **options)
    with atomic_file(path) as unfinished:
        figure.savefig(unfinished, format="svg", metadata={"Date": None})


def average(
    curves: Mapping[str, Mapping[str, list[dict[str, Any]]]], execution: str
) -> list[dict[str, Any]]:
    """Average an execution over tasks, at the delays at which all of them were measured.

    Returns:
        Points with `delay`, `success` and its 95 % interval `ci95` in percent, `action_delta` and
        `jerk`.
    """
    tasks = [{p["delay"]: p for p in task.get(execution, [])} for task in curves.values()]
    averages = []
    for delay in sorted(set.intersection(*map(set, tasks)) if tasks else ()):
        points = [task[delay] for task in tasks]
        outcomes = "".join(point["outcomes"] for point in points)
        interval = wilson_interval(outcomes.count("1"), len(outcomes))
        means = {name: float(np.mean([p[name] for p in points])) for name in ROWS}
        means["success"] *= 100
        averages.append({"delay": delay, "ci95": [100 * bound for bound in interval], **means})
    return averages


def _line(axes: Any, points: list[dict[str, Any]], field: str, label: str, color: str) -> None:
    """Draw one execution, with the interval of its success rate."""
    if not points:
        return
    delays = [point["delay"] for point in points]
    axes.plot(delays, [p[field] for p in points], "o-", ms=3, lw=1.5, color=color, label=label)
    if field == "success":
        low, high = zip(*(point["ci95"] for point in points), strict=True)
        axes.fill_between(delays, low, high, color=color, alpha=0.15, lw=0)
