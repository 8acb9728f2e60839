"""Draw the figure that explains LoRA-SP, from a real forward pass.

    python docs/figures/lora_sp.py                  # redraw from lora_sp.npz
    python docs/figures/lora_sp.py runs/multitask   # measure a finished run first

Writes lora_sp_light.svg and lora_sp_dark.svg next to this file.
"""

import argparse
import functools
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch, Rectangle
from matplotlib.ticker import MaxNLocator

HERE = Path(__file__).parent
SCHEMES = {
    "light": {"ink": "#1f2328", "soft": "#8b949e", "pruned": "#d0d7de", "fill": "#f6f8fa"},
    "dark": {"ink": "#e6edf3", "soft": "#8b949e", "pruned": "#3d444d", "fill": "#161b22"},
}
"""Colors for GitHub's light and dark themes; the background is transparent."""
TOKENS = "#12b886", "#f76707"
"""Colors of a token with few active directions and of a token with many."""
HEAT = LinearSegmentedColormap.from_list("rank", [TOKENS[0], "#ffd43b", TOKENS[1]])
"""Color map of the active rank; its ends are the tokens' colors."""
GRAY = np.array([0.299, 0.587, 0.114])
"""Luma of RGB (ITU-R BT.601)."""


def main() -> None:
    """Measure a run if one is given, then draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, nargs="?", help="folder of a finished run")
    parser.add_argument("--task", default="press")
    parser.add_argument("--steps", type=int, default=8, help="control steps before the measurement")
    options = parser.parse_args()
    if options.run:
        from measure_lora_sp import measure  # imported here: redrawing needs no JAX

        measurements = measure(options.run, options.task, options.steps)
        np.savez_compressed(HERE / "lora_sp.npz", **measurements)
    data = dict(np.load(HERE / "lora_sp.npz"))
    for scheme, colors in SCHEMES.items():
        draw(data, colors, HERE / f"lora_sp_{scheme}.svg")


def draw(data: dict[str, np.ndarray], colors: dict[str, str], path: Path) -> None:
    """Draw the figure in one color scheme."""
    style: Any = {
        "text.color": colors["ink"],
        "axes.edgecolor": colors["soft"],
        "axes.labelcolor": colors["ink"],
        "xtick.color": colors["ink"],
        "ytick.color": colors["ink"],
        "axes.spines.top": False,
        "axes.spines.right": False,
        "font.size": 10,
        "svg.hashsalt": "lorasp_jax",
    }
    with mpl.rc_context(style):
        figure = Figure(figsize=(12.4, 4.1))
        draw_layer(figure.add_axes((0.0, 0.0, 0.5, 0.9)), data, colors)
        for token, bottom in enumerate((0.575, 0.125)):
            axes = figure.add_axes((0.545, bottom, 0.175, 0.31))
            draw_energies(axes, data, colors, token)
        draw_rank_map(figure, data)
        titles = {
            0.25: r"one adapted layer:  $y = xW + xV\,\Sigma(x)\,U$",
            0.632: "two patches: sorted energy $s_i^2$",
            0.857: "active rank of each patch",
        }
        for x, text in titles.items():
            figure.text(x, 0.945, text, ha="center", weight="bold", size=11)
        figure.savefig(path, transparent=True, metadata={"Date": None})


def draw_layer(axes: Axes, data: dict[str, np.ndarray], colors: dict[str, str]) -> None:
    """Draw the data flow: x through W, and through V, the gated scores and U."""
    axes.set(xlim=(0, 100), ylim=(0, 66))
    axes.axis("off")
    mask, scores = data["mask"][0], data["scores"][0]
    text = functools.partial(axes.text, ha="center", va="center")
    arrow = functools.partial(_arrow, axes, colors["soft"])
    # The frozen kernel.
    text(3, 33, "$x$", size=17)
    _box(axes, (32, 51), (30, 10), colors)
    text(47, 56, "$W$  frozen", size=12)
    arrow((5.5, 36), (30.5, 56))
    arrow((62.5, 56), (88.8, 37.2))
    # The bank.
    draw_bank(axes, (20, 25), (17, 16), mask, colors, upright=True)
    text(28.5, 44, "$V$", size=12)
    arrow((5.8, 33), (18.8, 33))
    arrow((38.2, 33), (45.4, 33))
    axes.add_patch(Circle((48.6, 33), 3, fc="none", ec=colors["ink"], lw=1.3))
    text(48.6, 33, "×", size=14)
    arrow((51.8, 33), (59.3, 33))
    draw_bank(axes, (60.5, 25), (17, 16), mask, colors, upright=False)
    text(69, 44, "$U$", size=12)
    arrow((78.7, 33), (87.2, 33))
    axes.add_patch(Circle((90.4, 33), 3, fc="none", ec=colors["ink"], lw=1.3))
    text(90.4, 33, "+", size=15)
    arrow((93.6, 33), (96.6, 33))
    text(98.4, 32.6, "$y$", size=17)
    # The router.
    _box(axes, (10, 6), (16, 10), colors)
    text(18, 11, "router", size=12)
    arrow((4.0, 29.3), (10.6, 17.2))
    arrow((26.8, 11), (31.6, 11))
    draw_scores(axes, (33.2, 5), (31, 13), scores, mask, colors)
    text(18, 2, "$s(x) \\geq 0$", size=11)
    text(48.6, 2, "gate: fewest directions that reach η", size=11)
    arrow((48.6, 20), (48.6, 29.3))


def draw_bank(axes, corner, size, mask, colors, *, upright: bool) -> None:
    """Draw the bank's directions; active ones are colored."""
    (x, y), (width, height), count = corner, size, len(mask)
    for i, active in enumerate(mask):
        step = (width if upright else height) / count
        position = (x + i * step, y) if upright else (x, y + (count - 1 - i) * step)
        side = (0.72 * step, height) if upright else (width, 0.72 * step)
        color = TOKENS[0] if active else colors["pruned"]
        axes.add_patch(Rectangle(position, *side, fc=color, lw=0))


def draw_scores(axes, corner, size, values, mask, colors) -> None:
    """Draw the scores in the order of the bank; active ones are colored."""
    (x, y), (width, height) = corner, size
    step, top = width / len(values), values.max()
    for i, (value, active) in enumerate(zip(values, mask, strict=True)):
        color = TOKENS[0] if active else colors["pruned"]
        position = x + i * step, y
        axes.add_patch(Rectangle(position, 0.72 * step, height * value / top, fc=color, lw=0))


def draw_energies(
    axes: Axes, data: dict[str, np.ndarray], colors: dict[str, str], token: int
) -> None:
    """Draw the sorted energies of one token, their cumulative sum and the energy target."""
    energy = np.sort(data["scores"][token] ** 2)[::-1]
    share = energy / energy.sum()
    cumulative, active = np.cumsum(share), int(data["mask"][token].sum())
    color, target = TOKENS[token], float(data["energy_target"])
    index = np.arange(1, len(share) + 1)
    fill = [color] * active + [colors["pruned"]] * (len(share) - active)
    axes.bar(index, share / share[0], color=fill, width=0.74)
    axes.plot(index, cumulative, color=colors["ink"], lw=1.4)
    axes.axhline(target, color=colors["soft"], lw=1, ls=(0, (4, 3)))
    axes.plot([active], [cumulative[active - 1]], "o", color=color, ms=6, zorder=3)
    above_left = active > len(share) / 2
    axes.annotate(
        f"$k$ = {active}",
        (active, cumulative[active - 1]),
        xytext=(-7, 6) if above_left else (7, -18),
        textcoords="offset points",
        ha="right" if above_left else "left",
        color=color,
        weight="bold",
        size=12,
    )
    axes.set(xlim=(0.2, len(share) + 0.8), ylim=(0, 1.16), yticks=[0, target])
    axes.set_yticklabels(["0", f"η = {target:g}"])
    axes.set_xticks([1, len(share)])
    axes.tick_params(size=2)
    if token:
        axes.set_xlabel("directions of the bank", labelpad=-7)


def draw_rank_map(figure: Figure, data: dict[str, np.ndarray]) -> None:
    """Draw the active rank of every patch over the camera image."""
    rank, gray = data["active_rank"], data["image"] @ GRAY
    axes, side = figure.add_axes((0.755, 0.19, 0.2045, 0.6185)), len(rank)
    axes.imshow(gray, cmap="gray", extent=(0, side, side, 0))
    overlay = axes.imshow(rank, cmap=HEAT, alpha=0.55, extent=(0, side, side, 0))
    for token, color in zip(data["token"], TOKENS, strict=True):
        row, column = divmod(int(token), side)
        for width, edge in ((5, "white"), (2.5, color)):
            axes.add_patch(Rectangle((column, row), 1, 1, fill=False, ec=edge, lw=width, zorder=3))
    axes.axis("off")
    bar = figure.colorbar(overlay, cax=figure.add_axes((0.966, 0.19, 0.008, 0.6185)))
    assert bar.solids is not None
    bar.solids.set_alpha(1)
    bar.outline.set_visible(False)  # type: ignore
    bar.ax.tick_params(size=0)
    bar.ax.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=6))


def _box(axes: Axes, corner: tuple, size: tuple, colors: dict[str, str]) -> None:
    style = "round,pad=0,rounding_size=1.2"
    patch = FancyBboxPatch(corner, *size, boxstyle=style, fc=colors["fill"], ec=colors["soft"])
    axes.add_patch(patch)


def _arrow(axes: Axes, color: str, start: tuple, end: tuple) -> None:
    style = {
        "arrowstyle": "-|>,head_length=5,head_width=2.6",
        "lw": 1.5,
        "shrinkA": 0,
        "shrinkB": 0,
    }
    axes.add_patch(FancyArrowPatch(start, end, color=color, **style))


if __name__ == "__main__":
    main()
