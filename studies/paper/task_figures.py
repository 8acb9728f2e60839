"""Figures that the paper lacks: what tasks share. See `figures` for their argument."""

from collections.abc import Iterable, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lorasp_jax.extras.study.page import BACKBONES
from lorasp_jax.report.figures import COLORS
from studies.paper import naming
from studies.paper.book import TASKS, Book
from studies.paper.figure_style import FULL, LORA_SP, legend, panels, rows
from studies.paper.naming import TOWERS
from studies.paper.tables import RANK

_ROW = 0.26
"""Height of a row [inches]."""


def shared_directions(book: Book) -> Figure:
    """Plot how far each pair of tasks uses the same directions, by tower, and what chance gives."""
    overlaps = {b: book.measures(f"{b}/multi/lora_sp", "direction_overlap") for b in BACKBONES}
    figure, grid = panels(1, 1.0 + 2 * _ROW * max(len(o[0]) for o in overlaps.values()))
    for axes, (backbone, cells) in zip(grid[0], overlaps.items(), strict=True):
        pairs = _in_order(cells[0])
        for offset, tower in zip((-0.22, 0, 0.22), TOWERS, strict=True):
            for row, pair in enumerate(pairs):
                values = [cell[pair][tower] for cell in cells]
                measured, chance = zip(*values, strict=True)
                _dots(axes, row + offset, measured, chance, COLORS[tower])
            axes.plot([], [], "o", color=COLORS[tower], label=tower)
        rows(axes, [_title(pair) for pair in pairs])
        axes.plot([], [], "o", mfc="none", color=FULL, label="by chance")
        axes.set_xlim(0, 1)
        axes.set_title(BACKBONES[backbone], loc="left")
        axes.set_xlabel("overlap of directions in use\n(0 none, 1 the same)")
    legend(figure, grid[0][0], columns=4)
    return figure


def gradients(book: Book) -> Figure:
    """Plot by method whether gradients of different tasks point the same way."""
    methods = {b: book.table_1_methods(b)[:-1] for b in BACKBONES}  # lora_cut is not trained
    figure, grid = panels(1, 1.0 + 1.2 * _ROW * max(map(len, methods.values())), sharex=True)
    for axes, backbone in zip(grid[0], BACKBONES, strict=True):
        for row, method in enumerate(methods[backbone]):
            two, one = book.cosines(f"{backbone}/multi/{method}")
            color = LORA_SP if method == "lora_sp" else mpl.rcParams["text.color"]
            _dots(axes, row, two, one, color)
        rows(axes, [naming.label(method, RANK) for method in methods[backbone]])
        axes.axvline(0, color="gray", lw=1)
        axes.set_title(BACKBONES[backbone], loc="left")
        axes.set_xlabel("cosine of two gradients")
    axes, ink = grid[0][0], mpl.rcParams["text.color"]
    axes.plot([], [], "o", color=ink, label="two tasks")
    axes.plot([], [], "o", color=LORA_SP, label="two tasks, LoRA-SP")
    axes.plot([], [], "o", mfc="none", color=FULL, label="two batches of one task")
    legend(figure, axes, columns=3)
    return figure


def _dots(
    axes: Axes, row: float, measured: Sequence[float], reference: Sequence[float], color: str
) -> None:
    """Draw means and ranges over seeds: a dot, and a gray ring to compare it with."""
    dot, ring = float(np.mean(measured)), float(np.mean(reference))
    axes.plot([dot, ring], [row, row], color=FULL, lw=0.5)
    axes.plot([min(reference), max(reference)], [row, row], color=FULL, lw=1.5)
    axes.plot([min(measured), max(measured)], [row, row], color=color, lw=1.5)
    axes.plot([dot], [row], "o", color=color, ms=5)
    axes.plot([ring], [row], "o", color=FULL, ms=5, mfc="none")


def _in_order(pairs: Iterable[str]) -> list[str]:
    """Return pairs of tasks, such as "pour|press", in the paper's order of tasks."""
    order = [*TASKS]
    return sorted(pairs, key=lambda pair: sorted(map(order.index, pair.split("|"))))


def _title(pair: str) -> str:
    return " + ".join(TASKS[task] for task in pair.split("|"))


DRAWINGS = {"directions": shared_directions, "gradients": gradients}
"""Figures by the name of their files."""
