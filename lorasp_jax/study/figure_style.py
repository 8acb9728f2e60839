"""Style of the study's figures."""

import io
from collections.abc import Callable
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from lorasp_jax.study.book import Book

SCHEMES = {
    "light": {"ink": "#1f2328", "soft": "#8b949e"},
    "dark": {"ink": "#e6edf3", "soft": "#8b949e"},
}
"""Colors for light and dark pages; the background is transparent."""
SERIES = ("#4269d0", "#efb118", "#ff725c", "#3ca951")
"""Colors of tasks and of methods."""


def svg(draw: Callable[[Book], Figure], book: Book, scheme: str) -> str:
    """Draw a figure in a color scheme, the same text every time."""
    ink, soft = SCHEMES[scheme]["ink"], SCHEMES[scheme]["soft"]
    style: Any = {
        **{f"{name}.color": ink for name in ("text", "xtick", "ytick", "lines")},
        **{"axes.labelcolor": ink, "axes.titlecolor": ink, "axes.edgecolor": soft},
        **{"axes.spines.top": False, "axes.spines.right": False, "font.size": 10},
        **{"axes.grid": True, "grid.alpha": 0.25, "grid.color": soft},
        **{"axes.facecolor": "none", "legend.frameon": False},
        **{"svg.fonttype": "path", "svg.hashsalt": "lorasp_jax"},
    }
    buffer = io.StringIO()
    with mpl.rc_context(style):
        draw(book).savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    return buffer.getvalue()


def panels(book: Book, rows: int, height: float) -> tuple[Figure, np.ndarray]:
    """Return a figure with a column of axes `[rows, columns]` for each backbone of a book."""
    columns = len(book.backbones)
    figure = Figure(figsize=(4.6 * columns, height), layout="constrained")
    return figure, figure.subplots(rows, columns, sharey=True, squeeze=False)
