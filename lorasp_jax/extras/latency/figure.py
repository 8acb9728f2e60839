"""Figure of success and smoothness against delay."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from lorasp_jax.base.intervals import wilson_interval
from lorasp_jax.base.writing import atomic_file
from lorasp_jax.evaluation.figure_style import STYLE
from lorasp_jax.extras.study.study import Results

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
def write(path: Path, runs: Sequence[tuple[str, Results]]) -> None:
    """Draw success and smoothness, averaged over tasks, and write them as SVG.

    Args:
        path: file to write.
        runs: name of each run, which gets one column, and results of its cells, see `curve.cells`.
    """
    figure = Figure(figsize=(1.2 + 3.4 * len(runs), 6.4), layout="constrained")
    axes = figure.subplots(len(ROWS), len(runs), sharex="col", sharey="row", squeeze=False)
    entries: dict[str, Any] = {}
    for column, (name, found) in enumerate(runs):
        axes[0, column].set_title(name, loc="left")
        period = next(iter(found.values()))["config"]["control_dt"]
        axes[-1, column].set_xlabel(f"delay [control steps of {1e3 * period:g} ms]")
        for execution, color in COLORS.items():
            points = average(found, execution)
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


def average(results: Results, execution: str) -> list[dict[str, Any]]:
    """Average an execution over tasks, at the delays at which all of them were measured.

    Returns:
        Points with `delay`, `success` and its 95 % interval `ci95` in percent, `action_delta` and
        `jerk`.
    """
    by_delay, tasks = dict[int, list[Any]](), set[str]()
    for result in results.values():
        if result["config"]["execution"] == execution:
            by_delay.setdefault(result["config"]["delay"], []).append(result)
            tasks |= result["outcomes"].keys()
    averages = []
    for delay, points in sorted(by_delay.items()):
        if len(points) < len(tasks):
            continue
        outcomes = "".join(text for point in points for text in point["outcomes"].values())
        successes, episodes = outcomes.count("1"), len(outcomes)
        motions = [point["motion"] for point in points]
        means = {n: float(np.mean([m[n] for m in motions])) for n in ROWS if n != "success"}
        bounds = [100 * bound for bound in wilson_interval(successes, episodes)]
        success = {"success": 100 * successes / episodes, "ci95": bounds}
        averages.append({"delay": delay, **success, **means})
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
