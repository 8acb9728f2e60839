"""Figures of a run, drawn from metrics.jsonl and results.json."""

import io
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from lorasp_jax.base.intervals import wilson_interval
from lorasp_jax.evaluation.figure_style import COLORS, STYLE

_STYLE = STYLE | {"font.size": 10}

_BARS = {"before": (-0.18, "before"), "after": (0.18, "vision")}
"""Offset of each bar, and key of its color in `COLORS`."""

Rows = Sequence[dict[str, float]]


@mpl.rc_context(_STYLE)
def svg(figure: Figure) -> str:
    """Render a figure as SVG."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


@mpl.rc_context(_STYLE)
def success(results: dict[str, Any]) -> Figure:
    """Plot success before training and, for a finished run, after it, with 95 % intervals."""
    tasks = results["tasks"]
    figure = Figure(figsize=(6, 1.1 + 0.8 * len(tasks)), layout="constrained")
    axes = figure.subplots()
    for row, task in enumerate(tasks):
        for name, (offset, color) in _BARS.items():
            if name not in tasks[task]:
                continue
            value = tasks[task][name]
            low, high = value["ci95"]
            rate = value["success"]
            axes.barh(row + offset, 100 * rate, height=0.32, color=COLORS[color])
            axes.plot([100 * low, 100 * high], [row + offset] * 2, color="black", lw=1.5)
            label = f"{name} {100 * rate:.0f} %"
            axes.annotate(
                label, (100 * high, row + offset), xytext=(6, -3), textcoords="offset points"
            )
    axes.set_yticks(range(len(tasks)), list(tasks))
    axes.invert_yaxis()
    axes.set_xlim(0, 118)
    axes.set_xticks(range(0, 101, 20))
    axes.set_xlabel("success [%], line: 95 % Wilson interval")
    axes.grid(axis="y", visible=False)
    return figure


@mpl.rc_context(_STYLE)
def losses(rows: Rows) -> Figure:
    """Plot task loss and auxiliary losses over steps."""
    figure = Figure(figsize=(9, 3), layout="constrained")
    left, right = figure.subplots(1, 2)
    _line(left, rows, "task", "#4269d0", "flow matching")
    left.set_yscale("log")
    left.set_title("flow-matching loss", loc="left")
    for name, color in (("spectral", "#ff725c"), ("balance", "#6cc5b0"), ("z", "#a463f2")):
        _line(right, rows, name, color, name)
    right.set_title("auxiliary losses, unweighted", loc="left")
    for axes in (left, right):
        axes.set_xlabel("step")
    if right.lines:
        right.set_yscale("log")
        right.legend(frameon=False)
    return figure


@mpl.rc_context(_STYLE)
def reinforcement(rows: Rows, episodes: int) -> Figure:
    """Plot success of rollouts, with 95 % intervals, and the divergence from the start policy.

    `episodes` is the number of episodes per task and iteration.
    """
    figure = Figure(figsize=(9, 3), layout="constrained")
    steps, minutes, right = figure.subplots(1, 3)
    names = sorted(name for name in rows[0] if name.startswith("rollout/"))
    for axes, x in ((steps, "environment_steps"), (minutes, "minutes")):
        for i, name in enumerate(names):
            values = [100 * row[name] for row in rows]
            bounds = [wilson_interval(round(row[name] * episodes), episodes) for row in rows]
            low, high = 100 * np.transpose(bounds)
            at = [row[x] for row in rows]
            task = name.removeprefix("rollout/")
            axes.plot(at, values, color=f"C{i}", label=task, lw=1.5)
            axes.fill_between(at, low, high, color=f"C{i}", alpha=0.2, lw=0)
            if (teacher := name.replace("rollout", "teacher")) in rows[0]:
                values = [100 * row[teacher] for row in rows]
                axes.plot(at, values, color=f"C{i}", ls=":", lw=1, label=f"{task}, teacher")
        axes.set_ylim(0, 103)
        axes.set_xlabel(x.replace("_", " "))
    steps.set_title("success of the rollouts [%]", loc="left")
    steps.legend(frameon=False, loc="lower right")
    _line(right, rows, "start_kl", COLORS["vision"], "from the start")
    _line(right, rows, "kl", COLORS["before"], "in an iteration")
    if right.lines:
        right.set_yscale("log")
        right.legend(frameon=False)
    right.set_title("KL divergence per action", loc="left")
    right.set_xlabel("iteration")
    return figure


@mpl.rc_context(_STYLE)
def held_out(rows: Rows) -> Figure:
    """Plot losses and action errors on held-out episodes over steps."""
    figure = Figure(figsize=(9, 3), layout="constrained")
    left, right = figure.subplots(1, 2)
    _line(left, rows, "task", COLORS["before"], "training")
    _line(left, rows, "validation/loss", COLORS["vision"], "held out")
    left.set_yscale("log")
    left.set_title("flow-matching loss", loc="left")
    _line(right, rows, "validation/action_error", COLORS["vision"], "policy")
    _line(right, rows, "validation/hold_still/action_error", COLORS["before"], "hold still")
    name = "validation/repeat/action_error"
    _line(right, rows, name, COLORS["language"], "repeat the previous action")
    right.set_ylim(0)
    right.set_title("action error [standard deviations]", loc="left")
    for axes in (left, right):
        axes.set_xlabel("step")
        axes.legend(frameon=False)
    return figure


@mpl.rc_context(_STYLE)
def success_over_steps(rows: Rows) -> Figure:
    """Plot the success of each task during training."""
    names = sorted({name for row in rows for name in row if name.startswith("success/")})
    curves = {name.removeprefix("success/"): (name, f"C{i}") for i, name in enumerate(names)}
    title = "success during training (fewer episodes than at the end)"
    return _curves(rows, curves, title, top=1.03, legend="lower right")


@mpl.rc_context(_STYLE)
def active_rank(rows: Rows, rank: int) -> Figure:
    """Plot the active rank of each tower over steps."""
    towers = ("vision", "language", "action")
    curves = {tower: (f"active_rank/{tower}", COLORS[tower]) for tower in towers}
    title = f"mean active rank by tower (dotted: bank size {rank})"
    figure = _curves(rows, curves, title, top=1.06 * rank, legend="lower left")
    figure.axes[0].axhline(rank, color="black", lw=1, ls=":")
    return figure


def _curves(
    rows: Rows, curves: dict[str, tuple[str, str]], title: str, top: float, legend: str
) -> Figure:
    """Plot metrics over steps; `curves` maps a label to a metric and a color."""
    figure = Figure(figsize=(9, 3), layout="constrained")
    axes: Any = figure.subplots()
    for label, (name, color) in curves.items():
        _line(axes, rows, name, color, label)
    axes.set_ylim(0, top)
    axes.set_xlabel("step")
    axes.set_title(title, loc="left")
    axes.legend(frameon=False, loc=legend)
    return figure


@mpl.rc_context(_STYLE)
def layer_ranks(layers: dict[str, dict[str, Sequence[float]]], rank: int) -> Figure:
    """Plot the active rank of every adapted layer after training, one panel per adapted tower."""
    layers = {tower: linears for tower, linears in layers.items() if linears}
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    panels = figure.subplots(1, len(layers), sharey=True, squeeze=False)[0]
    for axes, (tower, linears) in zip(panels, layers.items(), strict=True):
        for position, values in enumerate(linears.values()):
            axes.scatter([position] * len(values), values, color=_color(tower), s=14)
        axes.set_xticks(range(len(linears)), list(linears), rotation=70, ha="right")
        axes.set_ylim(0, 1.06 * rank)
        axes.set_title(tower, loc="left")
    panels[0].set_ylabel("active rank, one dot per layer")
    return figure


@mpl.rc_context(_STYLE)
def rank_histogram(histogram: dict[str, Sequence[int]]) -> Figure:
    """Plot the distribution of active rank over tokens, one panel per tower.

    `histogram` maps a tower to its numbers of tokens with active rank 0, 1, ...
    """
    figure = Figure(figsize=(9, 2.8), layout="constrained")
    panels = figure.subplots(1, len(histogram), sharey=True, squeeze=False)[0]
    for axes, (tower, counts) in zip(panels, histogram.items(), strict=True):
        total = max(sum(counts), 1)
        percentages = [100 * count / total for count in counts]
        axes.bar(range(len(counts)), percentages, width=1.0, color=_color(tower))
        axes.set_xlim(-0.5, len(counts) - 0.5)
        axes.set_xlabel("active rank of a token")
        axes.set_title(tower, loc="left")
    panels[0].set_ylabel("tokens [%]")
    return figure


def _color(tower: str) -> str:
    """Return a tower's color, or gray for a tower that this version does not know."""
    return COLORS.get(tower, COLORS["before"])


def _line(axes: Any, rows: Rows, name: str, color: str, label: str) -> None:
    """Plot one metric at the steps that recorded it."""
    points = [(row["step"], row[name]) for row in rows if name in row]
    if points:
        marker = "o" if len(points) == 1 else None  # a line needs two
        axes.plot(*zip(*points, strict=True), color=color, label=label, lw=1.5, marker=marker)
