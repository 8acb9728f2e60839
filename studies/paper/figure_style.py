"""Style of the study's figures."""

import io
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lorasp_jax.evaluation.figure_style import STYLE
from lorasp_jax.extras.study.page import BACKBONES
from studies.paper.book import Book

INKS = {"light": "#1f2328", "dark": "#e6edf3"}
"""Color of text and lines by color scheme of the page; the background is transparent."""
SOFT = "#8b949e"
"""Color of frames and grids in both schemes."""
LORA_SP, LORA, SINGLE, FULL = "#ff725c", "#a463f2", "#9c6b4e", "#8b949e"
"""Colors of LoRA-SP, of LoRA, of LoRA for single tasks, and of full fine-tuning in all figures."""
WIDTH = 7.2
"""Width of a figure [inches], that of a page, so that text keeps its size."""


def svgs(draw: Callable[[Book], Figure], book: Book) -> dict[str, str]:
    """Draw a figure, the same every time; return it by color scheme.

    It is drawn once: the schemes differ only in the ink, whose color nothing else has.
    """
    ink = INKS["light"]
    style: Any = {
        **STYLE,
        **{f"{name}.color": ink for name in ("text", "xtick", "ytick", "lines")},
        **{"axes.labelcolor": ink, "axes.titlecolor": ink, "axes.edgecolor": SOFT},
        **{"axes.titlesize": 10, "grid.color": SOFT},
        **{"axes.facecolor": "none", "legend.frameon": False},
    }
    buffer = io.StringIO()
    with mpl.rc_context(style):
        draw(book).savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    return {scheme: text.replace(ink, other) for scheme, other in INKS.items()}


def panels(rows: int, height: float, **subplots: Any) -> tuple[Figure, np.ndarray]:
    """Return a figure with a column of axes `[rows, columns]` for each backbone."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    options: Any = {"sharey": True, "squeeze": False, **subplots}
    return figure, figure.subplots(rows, len(BACKBONES), **options)


def rows(axes: Axes, labels: Sequence[str]) -> None:
    """Label the rows of a panel, from top to bottom."""
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.5, -0.5)


def legend(figure: Figure, axes: Axes, columns: int) -> None:
    """Put the legend of a panel above the figure; entries fill one column after another."""
    entries = axes.get_legend_handles_labels()
    figure.legend(*entries, loc="outside upper center", ncols=columns)
