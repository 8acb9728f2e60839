"""The figure of README.md: success against the number of demonstrations."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from lorasp_jax.evaluation.figure_style import STYLE
from lorasp_jax.extras.study import figure as figures
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


@mpl.rc_context(STYLE)
def write(path: Path, backbones: Sequence[str], points: Points) -> None:
    """Draw a row per scene, and a column per backbone and augmentation; write it as SVG."""
    columns = [(backbone, kind) for backbone in backbones for kind in page.AUGMENT]
    figure = Figure(figsize=(1.2 + 3.2 * len(columns), 5.4), layout="constrained")
    axes = figure.subplots(len(page.SCENES), len(columns), sharex=True, sharey=True, squeeze=False)
    for column, (backbone, kind) in enumerate(columns):
        for row, scene in enumerate(page.SCENES):
            methods = points[backbone, scene, kind]
            curves = {page.LABELS[name]: (COLORS[name], found) for name, found in methods.items()}
            figures.panel(axes[row, column], page.COUNTS, curves)
        title = f"{page.BACKBONES[backbone]}, {page.AUGMENT[kind]} augmentation"
        axes[0, column].set_title(title, loc="left")
        axes[-1, column].set_xlabel("demonstrations of each task")
    for row, label in zip(axes, page.SCENES.values(), strict=True):
        row[0].set_ylabel(f"success, {label} [%]")
    figures.write(figure, path, "few")
