"""Figures 1, 3, 4 and 6 of the paper, from the results of its study."""

import io
from collections.abc import Callable
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lorasp_jax.report.figures import COLORS
from lorasp_jax.study import published, statistics
from lorasp_jax.study.naming import TOWERS
from lorasp_jax.study.tables import BACKBONES, TASKS, Book

SCHEMES = {
    "light": {"ink": "#1f2328", "soft": "#8b949e"},
    "dark": {"ink": "#e6edf3", "soft": "#8b949e"},
}
"""Colors for light and dark pages; the background is transparent."""
_TASK_COLORS = ("#4269d0", "#efb118", "#ff725c", "#3ca951")
_SEEN = {"panda": "#9498a0", "multi": "#ff725c"}
_PERCENT = range(0, 101, 20)


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


def needs(book: Book, figure: int) -> list[str]:
    """Return the methods that a figure shows, such as "pi0/multi/lora_r2"."""
    found = []
    for backbone in book.backbones:
        lora = {
            kind: [f"{backbone}/{kind}/lora_r{rank}" for rank in book.ranks(backbone, "multi")]
            for kind in ("multi", "single")
        }
        full, sp = f"{backbone}/multi/full", f"{backbone}/multi/lora_sp"
        found += {
            1: [*lora["multi"], full, sp],
            3: [*lora["single"], *lora["multi"]],
            4: [full, f"{backbone}/panda/full"],
            6: [sp],
        }[figure]
    return found


def figure_1(book: Book) -> Figure:
    """Plot multi-task success relative to full fine-tuning against rank, as in Figure 1."""
    figure, panels = _panels(book, 1, height=3.6)
    for axes, backbone in zip(panels[0], book.backbones, strict=True):
        ranks = book.ranks(backbone, "multi")
        lora = [_relative_success(book, backbone, f"lora_r{rank}") for rank in ranks]
        points = np.array(lora)
        axes.fill_between(ranks, points[:, 1], points[:, 2], color=_TASK_COLORS[0], alpha=0.2, lw=0)
        axes.plot(ranks, points[:, 0], "o-", color=_TASK_COLORS[0], label="LoRA")
        _papers(axes, book, backbone, ranks)
        value, low, high = _relative_success(book, backbone, "lora_sp")
        errors = [[value - low], [high - value]]
        mean = book.mean(f"{backbone}/multi/lora_sp", "active_rank", "mean")
        axes.errorbar([mean or 1], [value], errors, fmt="D", color=_TASK_COLORS[2], label="LoRA-SP")
        axes.axhline(100, color="gray", lw=1, ls=":")
        _rank_axis(axes, ranks)
        axes.set_title(BACKBONES[backbone], loc="left")
    panels[0][0].set_ylabel("success relative to full\nfine-tuning [%], four tasks")
    panels[0][0].legend(loc="lower right")
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


def figure_3(book: Book) -> Figure:
    """Plot the success of LoRA by task against rank, single-task and multi-task (Figure 3)."""
    figure, panels = _panels(book, 2, height=5.6)
    for row, training in enumerate(("single", "multi")):
        for axes, backbone in zip(panels[row], book.backbones, strict=True):
            ranks = book.ranks(backbone, training)
            prefixes = [f"{backbone}/{training}/lora_r{rank}" for rank in ranks]
            rates = 100 * np.array([book.outcomes(prefix).mean((0, 2)) for prefix in prefixes])
            axes.fill_between(ranks, rates.min(1), rates.max(1), color="gray", alpha=0.15, lw=0)
            tasks = book.tasks(prefixes[0])
            for task, color in zip(TASKS, _TASK_COLORS, strict=True):
                if task in tasks:
                    values = rates[:, tasks.index(task)]
                    axes.plot(ranks, values, "o-", color=color, ms=4, label=TASKS[task])
            _rank_axis(axes, ranks)
            kind = "one policy per task" if training == "single" else "one policy for all tasks"
            axes.set_title(f"{BACKBONES[backbone]}, {kind}", loc="left")
            axes.set_ylim(0, 103)
        panels[row][0].set_ylabel("success of LoRA [%]")
    panels[0][0].legend(loc="lower right")
    return figure


def figure_4(book: Book) -> Figure:
    """Plot the share of singular values that full fine-tuning's updates need (Figure 4)."""
    figure, panels = _panels(book, 1, height=3.6)
    for axes, backbone in zip(panels[0], book.backbones, strict=True):
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
    panels[0][0].set_ylabel("share of singular values\nfor 99 % of the energy")
    panels[0][0].legend(loc="lower right")
    return figure


def _shares(book: Book, prefix: str, tower: str) -> list[float]:
    """Return the shares of all layers of a tower that changed, of all seeds."""
    cells = [book.results[name] for (name,) in book.cells(prefix)]
    layers = [row for c in cells for row in c["measures"]["spectral_rank"][tower].values()]
    return [share for row in layers for share in row if share is not None]


def figure_6(book: Book) -> Figure:
    """Plot LoRA-SP's active rank over held-out tokens, a box for each layer (Figure 6)."""
    backbones = book.backbones
    figure = Figure(figsize=(10, 2.9 * len(backbones)), layout="constrained")
    panels = figure.subplots(len(backbones), len(TOWERS), sharey=True, squeeze=False)
    for row, backbone in zip(panels, backbones, strict=True):
        (first, *_), *_ = book.cells(f"{backbone}/multi/lora_sp")
        boxes = book.results[first]["measures"]["rank_boxes"]
        for axes, tower in zip(row, TOWERS, strict=True):
            _boxes(axes, boxes.get(tower, {}), COLORS[tower])
            axes.set_title(f"{BACKBONES[backbone]}, {tower}", loc="left")
            axes.set_ylim(0, 1.03 * book.rank)
        row[0].set_ylabel("active rank")
    return figure


def _boxes(axes: Axes, linears: dict[str, list[list[float]]], color: str) -> None:
    """Draw a box for each layer; the layers of one linear map stand side by side."""
    keys = ("whislo", "q1", "med", "q3", "whishi")
    statistics, positions, ticks = [], [], []
    for start, (_, layers) in enumerate(linears.items()):
        width = 0.8 / len(layers)
        for index, numbers in enumerate(layers):
            statistics.append({**dict(zip(keys, numbers, strict=True)), "fliers": []})
            positions.append(start + width * (index - (len(layers) - 1) / 2))
        ticks.append(start)
    if not statistics:
        return
    widths = [0.8 / len(layers) * 0.8 for layers in linears.values() for _ in layers]
    ink = mpl.rcParams["text.color"]
    axes.bxp(
        statistics,
        positions=positions,
        widths=widths,
        showcaps=False,
        patch_artist=True,
        manage_ticks=False,
        boxprops={"facecolor": color, "alpha": 0.8, "lw": 0.5},
        medianprops={"color": ink, "lw": 1},
        whiskerprops={"color": color, "lw": 0.8},
    )
    axes.set_xticks(ticks, list(linears), rotation=70, ha="right", fontsize=8)


def _panels(book: Book, rows: int, height: float) -> tuple[Figure, np.ndarray]:
    columns = len(book.backbones)
    figure = Figure(figsize=(4.6 * columns, height), layout="constrained")
    return figure, figure.subplots(rows, columns, sharey=True, squeeze=False)


def _rank_axis(axes: Axes, ranks: list[int]) -> None:
    axes.set_xscale("log", base=2)
    axes.set_xticks(ranks, [f"{rank}" for rank in ranks])
    axes.minorticks_off()
    axes.set_xlabel("rank")


DRAWINGS: dict[int, Callable[[Book], Figure]] = {
    1: figure_1,
    3: figure_3,
    4: figure_4,
    6: figure_6,
}
"""Figures by the paper's number."""
