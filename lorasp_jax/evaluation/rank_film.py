"""Draw an episode with each image patch tinted by its active rank, above the rank of each tower."""

from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from lorasp_jax.evaluation.figure_style import COLORS

TINT = 0.55
"""Share of the rank's color in a tinted pixel; the rest is the gray image."""
_COLORMAP = mpl.colormaps["viridis"]
_EXTREMES = (1, 99)
"""Percentiles of the patches' ranks at the ends of the color scale."""
_GRAY = np.array([0.299, 0.587, 0.114])  # luma of ITU-R BT.601
_SIZE = (6.4, 4.8)  # inches of 100 pixels


def tint(images: np.ndarray, ranks: np.ndarray, scale: Normalize) -> np.ndarray:
    """Tint each patch of gray images by its rank.

    Args:
        images: uint8 `[..., H, H, 3]`.
        ranks: `[..., P, P]`, one per patch.
        scale: maps ranks to the range of the color scale.

    Returns:
        uint8 `[..., H, H, 3]`.
    """
    size, side = images.shape[-2], ranks.shape[-1]
    patch = np.arange(size) * side // size
    color = _COLORMAP(scale(ranks))[..., :3][..., patch[:, None], patch, :]
    gray = images / 255 @ _GRAY
    return np.rint(255 * (TINT * color + (1 - TINT) * gray[..., None])).astype(np.uint8)


def draw(
    images: Mapping[str, np.ndarray],
    patches: Mapping[str, np.ndarray],
    towers: Mapping[str, np.ndarray],
    *,
    title: str,
    control_dt: float,
) -> np.ndarray:
    """Draw one frame per control step.

    Args:
        images: camera -> uint8 `[T, H, H, 3]`.
        patches: camera -> `[T, P, P]` active rank of each patch.
        towers: tower -> `[T]` mean active rank.
        title: heading of the film.
        control_dt: control period [s].

    Returns:
        uint8 `[T, 480, 640, 3]`.
    """
    low, high = np.percentile(np.stack([*patches.values()]), _EXTREMES)
    scale = Normalize(low, max(high, low + 1), clip=True)
    tinted = {camera: tint(images[camera], patches[camera], scale) for camera in patches}
    figure = Figure(figsize=_SIZE, dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=10)
    rows: Any = [[*tinted], ["time"] * len(tinted)]
    axes: Any = figure.subplot_mosaic(rows, height_ratios=(2, 1))
    shown = {camera: axes[camera].imshow(frames[0]) for camera, frames in tinted.items()}
    for camera in shown:
        axes[camera].set_title(f"{camera} camera", fontsize=9)
        axes[camera].set_axis_off()
    legend, panels = mpl.cm.ScalarMappable(scale, _COLORMAP), [axes[camera] for camera in shown]
    bar = figure.colorbar(legend, ax=panels, extend="both", alpha=TINT, fraction=0.05)
    bar.set_label("active rank of a patch")
    mark = _curves(axes["time"], towers, control_dt)
    canvas.draw()
    figure.set_layout_engine("none")  # or the axes would move from frame to frame
    frames = []
    for step in range(len(next(iter(tinted.values())))):
        for camera, image in shown.items():
            image.set_data(tinted[camera][step])
        mark.set_xdata([control_dt * step] * 2)
        canvas.draw()
        frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return np.stack(frames)


def _curves(axes: Any, towers: Mapping[str, np.ndarray], control_dt: float) -> Any:
    """Draw the mean active rank of each tower; return the line that marks the time."""
    for tower in (name for name in COLORS if name in towers):
        ranks = towers[tower]
        axes.plot(control_dt * np.arange(len(ranks)), ranks, color=COLORS[tower], label=tower)
    axes.set_ylim(0, 1.15 * max(ranks.max() for ranks in towers.values()))
    axes.set_xlabel("time [s]")
    axes.set_ylabel("mean active rank")
    axes.legend(frameon=False, loc="lower right", ncols=len(towers))
    return axes.axvline(0, color="black", lw=1)
