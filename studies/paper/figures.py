"""Figures 1, 3, 4 and 6 of the paper."""

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from lorasp_jax.extras.study import statistics
from lorasp_jax.extras.study.page import BACKBONES
from lorasp_jax.extras.study.statistics import Estimate
from lorasp_jax.report.figures import COLORS
from studies.paper import estimates, naming, published
from studies.paper.book import Book
from studies.paper.figure_style import FULL, LORA, LORA_SP, SINGLE, legend, panels, rows
from studies.paper.naming import TOWERS
from studies.paper.tables import RANK

_TRAININGS = {"single": ("one policy per task", SINGLE, "s"), "multi": ("one for all", LORA, "o")}
_ROBOTS = {"panda": "Panda (seen), new scene", "multi": "PiPER (unseen)"}
_FORWARD = (
    *("patch_embed", "state_proj", "action_in_proj", "action_time_mlp_in", "action_time_mlp_out"),
    *("q_proj", "k_proj", "v_proj", "o_proj", "out_proj", "gate_proj", "up_proj", "down_proj"),
    *("fc1", "fc2", "head", "action_out_proj"),
)
"""Kinds of linear layers in the order in which a token meets them; others follow."""


def figure_1(book: Book) -> Figure:
    """Plot multi-task success relative to full fine-tuning against rank, as in Figure 1."""
    figure, grid = panels(1, height=3.3)
    for axes, backbone in zip(grid[0], BACKBONES, strict=True):
        ranks = book.ranks(backbone)
        lora = [_relative_success(book, backbone, f"lora_r{rank}") for rank in ranks]
        _band(axes, ranks, lora, LORA, "o", "LoRA")
        _paper_lora(axes, backbone, ranks)
        value, low, high = _relative_success(book, backbone, "lora_sp")
        errors = [[value - low], [high - value]]
        mean = book.mean(f"{backbone}/multi/lora_sp", "active_rank", "mean")
        axes.errorbar([mean or 1], [value], errors, color=LORA_SP)
        axes.plot([mean or 1], [value], "D", color=LORA_SP, label="LoRA-SP")
        _paper_lora_sp(axes, backbone)
        axes.axhline(100, color=FULL, lw=1.5, ls=":", label="full fine-tuning")
        _rank_axis(axes, ranks)
        axes.set_xlabel("rank (LoRA-SP: mean active rank)")
        axes.set_title(BACKBONES[backbone], loc="left")
    grid[0][0].set_ylim(0)
    grid[0][0].set_ylabel("success relative to\nfull fine-tuning [%]")
    legend(figure, grid[0][0], columns=3)
    return figure


def _relative_success(book: Book, backbone: str, method: str) -> Estimate:
    """Return success relative to full fine-tuning and its interval [%]."""
    pair = (book.outcomes(f"{backbone}/multi/{m}") for m in (method, "full"))
    return _percent(statistics.bootstrap(estimates.ratio, *pair))


def _percent(estimate: Estimate) -> Estimate:
    return Estimate(*(100 * x for x in estimate))


def _band(
    axes: Axes, ranks: list[int], points: Sequence[Estimate], color: str, marker: str, label: str
) -> None:
    """Plot estimates against rank, with a band for their intervals."""
    values, low, high = zip(*points, strict=True)
    axes.fill_between(ranks, low, high, color=color, alpha=0.2, lw=0)
    axes.plot(ranks, values, f"{marker}-", color=color, ms=5, label=label)


def _paper_lora(axes: Axes, backbone: str, ranks: list[int]) -> None:
    """Plot the paper's LoRA at the same fractions of R."""
    found = {r: _paper(backbone, f"lora_r{r}") for r in ranks}
    points = {rank: value for rank, value in found.items() if value is not None}
    style = {"color": LORA, "mfc": "none", "ms": 5, "label": "LoRA, paper (ranks halved)"}
    axes.plot(list(points), list(points.values()), "o--", **style)


def _paper_lora_sp(axes: Axes, backbone: str) -> None:
    cell = published.cell(f"{backbone}/multi/lora_sp", RANK)
    rank, value = cell["active_rank"] * RANK / published.RANK, _paper(backbone, "lora_sp")
    label = "LoRA-SP, paper (ranks halved)"
    axes.plot([rank], [value or 0.0], "D", color=LORA_SP, mfc="none", label=label)


def _paper(backbone: str, method: str) -> float | None:
    """Return the paper's success relative to full fine-tuning [%]; None if it has none."""
    prefixes = [f"{backbone}/multi/{m}" for m in (method, "full")]
    ratio = published.compute(estimates.ratio, prefixes, RANK)
    return None if ratio is None else 100 * float(ratio)


def figure_3(book: Book) -> Figure:
    """Plot mean and deviation over tasks of LoRA's success against rank (Figure 3)."""
    figure, grid = panels(2, height=5.2, sharey="row")
    for (top, bottom), backbone in zip(grid.T, BACKBONES, strict=True):
        ranks = book.ranks(backbone)
        for training, (title, color, marker) in _TRAININGS.items():
            found = [book.outcomes(f"{backbone}/{training}/lora_r{rank}") for rank in ranks]
            means = [_percent(statistics.success(outcomes)) for outcomes in found]
            _band(top, ranks, means, color, marker, f"LoRA, {title}")
            spreads = [_percent(_deviation(outcomes)) for outcomes in found]
            _band(bottom, ranks, spreads, color, marker, title)
        for training, (title, color, _) in _TRAININGS.items():  # the legend's second column
            full = 100 * book.outcomes(f"{backbone}/{training}/full").mean()
            top.axhline(full, color=color, lw=1.5, ls=":", label=f"full fine-tuning, {title}")
        for axes in (top, bottom):
            _rank_axis(axes, ranks)
        top.set_title(BACKBONES[backbone], loc="left")
        top.set_ylim(0, 103)
    grid[1][0].set_ylim(0)
    grid[0][0].set_ylabel("mean success [%]")
    grid[1][0].set_ylabel("LoRA's standard deviation\nover tasks [points]")
    legend(figure, grid[0][0], columns=2)
    return figure


def _deviation(outcomes: np.ndarray) -> Estimate:
    """Return the standard deviation over tasks; the correction can take it below 0, where it ends.

    See `estimates.corrected`.
    """
    estimate = estimates.corrected(lambda rates: rates.std(-1), outcomes)
    return Estimate(*(max(0.0, x) for x in estimate))


def figure_4(book: Book) -> Figure:
    """Plot the share of singular values that full fine-tuning's updates need (Figure 4)."""
    figure, grid = panels(1, height=3.2)
    styles = {"panda": {"facecolor": "none"}, "multi": {"facecolor": FULL, "alpha": 0.8}}
    for axes, backbone in zip(grid[0], BACKBONES, strict=True):
        for offset, (training, style) in zip((-0.18, 0.18), styles.items(), strict=True):
            shares = [_shares(book, f"{backbone}/{training}/full", tower) for tower in TOWERS]
            axes.boxplot(
                shares,
                positions=np.arange(len(TOWERS)) + offset,
                widths=0.3,
                whis=(0, 100),
                patch_artist=True,
                manage_ticks=False,
                boxprops={"edgecolor": FULL, **style},
                medianprops={"color": mpl.rcParams["text.color"]},
                whiskerprops={"color": FULL},
                showcaps=False,
            )
        axes.set_xticks(range(len(TOWERS)), TOWERS)
        axes.set_ylim(0, 1)
        axes.set_title(BACKBONES[backbone], loc="left")
    grid[0][0].set_ylabel("share of singular values with\n99 % of full fine-tuning's update")
    boxes = [Patch(edgecolor=FULL, label=_ROBOTS[name], **style) for name, style in styles.items()]
    figure.legend(handles=boxes, loc="outside upper center", ncols=2)
    return figure


def _shares(book: Book, prefix: str, tower: str) -> list[float]:
    """Return the shares of all layers of a tower that changed, of all seeds."""
    cells = book.measures(prefix, "spectral_rank")
    layers = [row for cell in cells for row in cell[tower].values()]
    return [share for row in layers for share in row if share is not None]


def figure_6(book: Book) -> Figure:
    """Plot LoRA-SP's active rank over held-out tokens by kind of layer (Figure 6)."""
    found = {b: book.rank_boxes(f"{b}/multi/lora_sp") for b in BACKBONES}
    kinds = [_in_order([kind for boxes in found.values() for kind in boxes[t]]) for t in TOWERS]
    heights = [len(names) + 1 for names in kinds]
    figure, grid = panels(
        len(TOWERS), 1.2 + 0.19 * sum(heights), sharey="row", height_ratios=heights
    )
    for column, (backbone, boxes) in zip(grid.T, found.items(), strict=True):
        for axes, tower, names in zip(column, TOWERS, kinds, strict=True):
            for row, name in enumerate(names):
                if name in boxes[tower]:
                    _layers(axes, row, boxes[tower][name], COLORS[tower])
            rows(axes, [naming.short_kind(name) for name in names])
            axes.axvline(RANK, color=mpl.rcParams["text.color"], lw=1, ls=":")
            axes.set_xlim(0, 1.03 * RANK)
            axes.set_title(f"{BACKBONES[backbone]}, {tower}", loc="left")
        column[-1].set_xlabel(f"active rank (dotted: R = {RANK})")
    return figure


def _in_order(kinds: Sequence[str]) -> list[str]:
    order = {kind: place for place, kind in enumerate(_FORWARD)}
    return sorted(dict.fromkeys(kinds), key=lambda kind: order.get(kind, len(order)))


def _layers(axes: Axes, row: int, layers: np.ndarray, color: str) -> None:
    """Draw the ranks in all layers of a kind: extremes, mean quartiles, each layer's median."""
    low, high = layers[..., 0].min(), layers[..., 4].max()
    axes.plot([low, high], [row, row], color=color, lw=1)
    left, right = layers[..., 1].mean(), layers[..., 3].mean()
    axes.barh(row, right - left, left=left, height=0.7, color=color, alpha=0.6)
    medians = layers[..., 2].mean(0)
    axes.plot(medians, [row] * len(medians), "o", color=mpl.rcParams["text.color"], ms=2.5)


def _rank_axis(axes: Axes, ranks: list[int]) -> None:
    axes.set_xscale("log", base=2)
    axes.set_xticks(ranks, [f"{rank}" for rank in ranks])
    axes.minorticks_off()
    axes.set_xlabel("rank")


DRAWINGS = {"figure_1": figure_1, "figure_3": figure_3, "figure_4": figure_4, "figure_6": figure_6}
"""Figures by the name of their files."""
