"""Figures 1, 3, 4 and 6 of the paper, for the backbones of a book, whose results must be there."""

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lorasp_jax.report.figures import COLORS
from lorasp_jax.study import naming, published, statistics
from lorasp_jax.study.book import BACKBONES, TASKS, Book
from lorasp_jax.study.figure_style import SERIES, panels
from lorasp_jax.study.naming import TOWERS

_SEEN = {"panda": "#9498a0", "multi": "#ff725c"}


def figure_1(book: Book) -> Figure:
    """Plot multi-task success relative to full fine-tuning against rank, as in Figure 1."""
    figure, grid = panels(book, 1, height=3.6)
    for axes, backbone in zip(grid[0], book.backbones, strict=True):
        ranks = book.ranks(backbone, "multi")
        lora = [_relative_success(book, backbone, f"lora_r{rank}") for rank in ranks]
        points = np.array(lora)
        axes.fill_between(ranks, points[:, 1], points[:, 2], color=SERIES[0], alpha=0.2, lw=0)
        axes.plot(ranks, points[:, 0], "o-", color=SERIES[0], label="LoRA")
        _papers(axes, book, backbone, ranks)
        value, low, high = _relative_success(book, backbone, "lora_sp")
        errors = [[value - low], [high - value]]
        mean = book.mean(f"{backbone}/multi/lora_sp", "active_rank", "mean")
        axes.errorbar([mean or 1], [value], errors, fmt="D", color=SERIES[2], label="LoRA-SP")
        axes.axhline(100, color="gray", lw=1, ls=":")
        _rank_axis(axes, ranks)
        axes.set_title(BACKBONES[backbone], loc="left")
    grid[0][0].set_ylabel("success relative to full\nfine-tuning [%], four tasks")
    grid[0][0].legend(loc="lower right")
    return figure


def _relative_success(book: Book, backbone: str, method: str) -> np.ndarray:
    """Return success relative to full fine-tuning and its interval [%]."""
    pair = (book.outcomes(f"{backbone}/multi/{m}") for m in (method, "full"))
    return 100 * np.array(statistics.bootstrap(_relative, *pair))


def _relative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a.mean(-1) / np.maximum(b.mean(-1), 1e-3)


def _papers(axes: Axes, book: Book, backbone: str, ranks: list[int]) -> None:
    """Plot the paper's points at the same fractions of R."""
    full = published.rates(f"{backbone}/multi/full", book.rank)
    rows = {r: published.rates(f"{backbone}/multi/lora_r{r}", book.rank) for r in ranks}
    if full is None:
        return
    rows = {r: 100 * _relative(row, full) for r, row in rows.items() if row is not None}
    axes.plot(list(rows), list(rows.values()), "s--", color="gray", ms=4, label="LoRA, paper")
    prefix = f"{backbone}/multi/lora_sp"
    rate, cell = published.rates(prefix, book.rank), published.cell(prefix, book.rank)
    if rate is not None:
        rank = cell["active_rank"] * book.rank / published.RANK
        axes.plot([rank], [100 * _relative(rate, full)], "D", color="gray", label="LoRA-SP, paper")


def figure_3(book: Book) -> Figure:
    """Plot the success of LoRA by task against rank, single-task and multi-task (Figure 3)."""
    figure, grid = panels(book, 2, height=5.6)
    for row, training in enumerate(("single", "multi")):
        for axes, backbone in zip(grid[row], book.backbones, strict=True):
            ranks = book.ranks(backbone, training)
            prefixes = [f"{backbone}/{training}/lora_r{rank}" for rank in ranks]
            rates = 100 * np.array([book.outcomes(prefix).mean((0, 2)) for prefix in prefixes])
            axes.fill_between(ranks, rates.min(1), rates.max(1), color="gray", alpha=0.15, lw=0)
            tasks = book.tasks(prefixes[0])
            for task, color in zip(TASKS, SERIES, strict=True):
                if task in tasks:
                    values = rates[:, tasks.index(task)]
                    axes.plot(ranks, values, "o-", color=color, ms=4, label=TASKS[task])
            _rank_axis(axes, ranks)
            kind = "one policy per task" if training == "single" else "one policy for all tasks"
            axes.set_title(f"{BACKBONES[backbone]}, {kind}", loc="left")
            axes.set_ylim(0, 103)
        grid[row][0].set_ylabel("success of LoRA [%]")
    grid[0][0].legend(loc="lower right")
    return figure


def figure_4(book: Book) -> Figure:
    """Plot the share of singular values that full fine-tuning's updates need (Figure 4)."""
    figure, grid = panels(book, 1, height=3.6)
    for axes, backbone in zip(grid[0], book.backbones, strict=True):
        for offset, (training, color) in zip((-0.18, 0.18), _SEEN.items(), strict=True):
            name = "Panda, seen" if training == "panda" else "PiPER, unseen"
            shares = [_shares(book, f"{backbone}/{training}/full", tower) for tower in TOWERS]
            boxes = axes.boxplot(
                shares,
                positions=np.arange(len(TOWERS)) + offset,
                widths=0.3,
                patch_artist=True,
                manage_ticks=False,
                medianprops={"color": mpl.rcParams["text.color"]},
                whiskerprops={"color": color},
                showcaps=False,
                flierprops={"ms": 3, "markeredgecolor": color},
            )
            for box in boxes["boxes"]:
                box.set(facecolor=color, alpha=0.7)
            boxes["boxes"][0].set_label(name)
        axes.set_xticks(range(len(TOWERS)), TOWERS)
        axes.set_ylim(0, 1)
        axes.set_title(BACKBONES[backbone], loc="left")
    grid[0][0].set_ylabel("share of singular values\nfor 99 % of the energy")
    grid[0][0].legend(loc="lower right")
    return figure


def _shares(book: Book, prefix: str, tower: str) -> list[float]:
    """Return the shares of all layers of a tower that changed, of all seeds."""
    cells = book.measures(prefix, "spectral_rank")
    layers = [row for cell in cells for row in cell[tower].values()]
    return [share for row in layers for share in row if share is not None]


def figure_6(book: Book) -> Figure:
    """Plot LoRA-SP's active rank over held-out tokens, a box for each layer (Figure 6)."""
    towers = {
        b: [naming.by_depth(tower) for tower in _first_boxes(book, b)] for b in book.backbones
    }
    figure = Figure(figsize=(10, 2.5 * len(towers)), layout="constrained")
    widths = [[sum(map(_width, tower.values())) for tower in row] for row in towers.values()]
    grid = figure.subplots(
        len(towers), len(TOWERS), sharey=True, squeeze=False, width_ratios=np.max(widths, axis=0)
    )
    for row, (backbone, linears) in zip(grid, towers.items(), strict=True):
        for axes, tower, kinds in zip(row, TOWERS, linears, strict=True):
            _boxes(axes, kinds, COLORS[tower])
            axes.set_title(f"{BACKBONES[backbone]}, {tower}", loc="left")
            axes.set_ylim(0, 1.03 * book.rank)
        row[0].set_ylabel("active rank")
    return figure


def _first_boxes(book: Book, backbone: str) -> list[dict[str, list[list[float]]]]:
    """Return the five-number summaries of the first seed's layers, for each tower."""
    boxes = book.measures(f"{backbone}/multi/lora_sp", "rank_boxes")[0]
    return [boxes.get(tower, {}) for tower in TOWERS]


def _width(layers: Sequence[Any]) -> int:
    """Return the room for the boxes of some layers, their label and a gap."""
    return max(len(layers), 2) + 1


def _boxes(axes: Axes, linears: dict[str, list[list[float]]], color: str) -> None:
    """Draw a box for each layer; the layers of one linear map stand side by side."""
    keys = ("whislo", "q1", "med", "q3", "whishi")
    statistics, positions, ticks, start = [], [], [], 0
    for layers in linears.values():
        statistics += [{**dict(zip(keys, five, strict=True)), "fliers": []} for five in layers]
        positions += range(start, start + len(layers))
        ticks.append(start + (len(layers) - 1) / 2)
        start += _width(layers)
    if not statistics:
        return
    axes.bxp(
        statistics,
        positions=positions,
        widths=0.7,
        showcaps=False,
        patch_artist=True,
        manage_ticks=False,
        boxprops={"facecolor": color, "alpha": 0.8, "lw": 0.5},
        medianprops={"color": mpl.rcParams["text.color"], "lw": 1},
        whiskerprops={"color": color, "lw": 0.8},
    )
    names = [name.removesuffix("_proj").replace("action_time_mlp", "time") for name in linears]
    axes.set_xticks(ticks, names, rotation=60, ha="right", rotation_mode="anchor", fontsize=8)
    axes.set_xlim(-1, start - 1)
    axes.grid(visible=False, axis="x")


def _rank_axis(axes: Axes, ranks: list[int]) -> None:
    axes.set_xscale("log", base=2)
    axes.set_xticks(ranks, [f"{rank}" for rank in ranks])
    axes.minorticks_off()
    axes.set_xlabel("rank")
