"""The figure of README.md: success against the number of demonstrations."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from lorasp_jax.base.writing import atomic_file
from lorasp_jax.evaluation.figure_style import STYLE
from lorasp_jax.extras.study.statistics import Estimate
from studies.few import page

COLORS = {
    "lora_r16": "#97bbf5",
    "lora_r64": "#4269d0",
    "lora_sp": "#ff725c",
    "vlm_lora": "#3ca951",
    "full": "#9498a0",
}
Points = Mapping[tuple[str, str, str], Mapping[str, Sequence[Estimate]]]
"""Success by (backbone, scene, augmentation), then method, for each of `page.COUNTS`."""


@mpl.rc_context(STYLE | {"svg.hashsalt": "few"})
def write(path: Path, points: Points) -> None:
    """Draw a row per scene, and a column per backbone and augmentation; write it as SVG."""
    columns = [(backbone, kind) for backbone in page.BACKBONES for kind in page.AUGMENT]
    figure = Figure(figsize=(1.2 + 3.2 * len(columns), 5.4), layout="constrained")
    axes = figure.subplots(len(page.SCENES), len(columns), sharex=True, sharey=True, squeeze=False)
    for column, (backbone, kind) in enumerate(columns):
        for row, scene in enumerate(page.SCENES):
            _panel(axes[row, column], points[backbone, scene, kind])
            title = f"{page.BACKBONES[backbone]}, {page.SCENES[scene]}"
            axes[row, column].set_title(f"{title}, {page.AUGMENT[kind]} augmentation", loc="left")
        axes[-1, column].set_xlabel("demonstrations of each task")
    for row in axes:
        row[0].set_ylabel("success [%]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    options: Any = {"loc": "outside upper center", "ncols": len(labels), "frameon": False}
    figure.legend(handles, labels, **options)
    with atomic_file(path) as unfinished:
        figure.savefig(unfinished, format="svg", metadata={"Date": None})


def _panel(axes: Any, methods: Mapping[str, Sequence[Estimate]]) -> None:
    for method, estimates in methods.items():
        value, low, high = ([100 * x for x in column] for column in zip(*estimates, strict=True))
        color = COLORS[method]
        axes.plot(page.COUNTS, value, color=color, marker="o", ms=3, label=page.LABELS[method])
        axes.fill_between(page.COUNTS, low, high, color=color, alpha=0.12, lw=0)
    axes.set_xscale("log")
    axes.set_xticks(page.COUNTS, [str(n) for n in page.COUNTS], minor=False)
    axes.minorticks_off()
    axes.set_ylim(0, 100)
