"""Figures of success rates against a setting of a study."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from lorasp_jax.base.writing import atomic_file
from lorasp_jax.evaluation.figure_style import STYLE
from lorasp_jax.extras.study.statistics import Estimate

Curves = Mapping[str, tuple[str, Sequence[Estimate]]]
"""Label -> color, and an estimate for each value of the setting."""


def panel(axes: Any, values: Sequence[float], curves: Curves) -> None:
    """Draw success [%] with its intervals against the values of a setting, on a log scale."""
    for label, (color, estimates) in curves.items():
        mean, low, high = ([100 * x for x in column] for column in zip(*estimates, strict=True))
        axes.plot(values, mean, color=color, marker="o", ms=3, label=label)
        axes.fill_between(values, low, high, color=color, alpha=0.12, lw=0)
    axes.set_xscale("log")
    axes.set_xticks(values, [str(value) for value in values], minor=False)
    axes.minorticks_off()
    axes.set_ylim(0, 100)


def write(figure: Figure, path: Path, salt: str) -> None:
    """Write a figure as SVG, with the labels of its first panel above; `salt` names its parts."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    options: Any = {"loc": "outside upper center", "ncols": len(labels), "frameon": False}
    figure.legend(handles, labels, **options)
    with mpl.rc_context(STYLE | {"svg.hashsalt": salt}), atomic_file(path) as unfinished:
        figure.savefig(unfinished, format="svg", metadata={"Date": None})
