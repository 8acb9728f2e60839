"""Draw recorded and predicted joints of a held-out episode, with camera frames above them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from envs.rendering.video import side_by_side
from lorasp_jax.base.files import join_inside
from lorasp_jax.base.writing import atomic_file
from lorasp_jax.data.source import Source
from lorasp_jax.evaluation.figure_style import COLORS, STYLE
from lorasp_jax.evaluation.held_out import Windows, sample, windows
from lorasp_jax.policies.policy import Policy

_FRAMES = 5
_COLUMNS = 2


def path(folder: Path, task: str) -> Path:
    """Return the file of a task's picture."""
    return join_inside(folder, f"held_out_{task.replace('/', '_')}.png")


def write(
    folder: Path, policy: Policy, source: Source, episodes: Sequence[int], *, num_steps: int
) -> list[Path]:
    """Draw the first of these episodes of each task; return the files."""
    first: dict[str, int] = {}
    for number in episodes:
        first.setdefault(source.episode(number, ()).task, number)
    paths = []
    for task, number in first.items():
        every = max(policy.model.config.chunk // 2, 1)
        found = windows(source, [number], policy, every=every)
        figure = draw(found, sample(policy, found, num_steps=num_steps))
        paths.append(path(folder, task))
        with atomic_file(paths[-1]) as unfinished:
            figure.savefig(unfinished, format="png", dpi=100)
    return paths


@mpl.rc_context(STYLE)
def draw(found: Windows, actions: np.ndarray) -> Figure:
    """Draw the windows of one episode and the chunks `[N, C, J+1]` predicted from them."""
    count = actions.shape[-1]
    rows = -(-count // _COLUMNS)
    figure = Figure(figsize=(10, 2 + 1.4 * rows), layout="constrained")
    grid = figure.add_gridspec(1 + rows, _COLUMNS, height_ratios=[1.3, *rows * [1]])
    _frames(figure.add_subplot(grid[0, :]), found)
    for number in range(count):
        axes = figure.add_subplot(grid[1 + number // _COLUMNS, number % _COLUMNS])
        name, scale = found.units[number]
        for row, start in enumerate(found.step):
            valid = np.asarray(found.raw.inside[row])
            time = found.control_dt * (start + np.arange(len(valid)))[valid]
            recorded = np.asarray(found.raw.actions)[row, valid, number]
            predicted = scale * actions[row, valid, number]
            axes.plot(time, scale * recorded, color=COLORS["before"], lw=2.5)
            axes.plot(time, predicted, color=COLORS["vision"], lw=1)
            axes.plot(time[:1], predicted[:1], ".", color=COLORS["vision"], ms=4)
        axes.set_title(name, loc="left", parse_math=False)
        if number >= count - _COLUMNS:
            axes.set_xlabel("time [s]; each chunk is predicted from the dot where it begins")
    figure.legend(figure.axes[1].lines[:2], ("recorded", "predicted"), loc="upper right", ncols=2)
    return figure


def _frames(axes: Any, found: Windows) -> None:
    """Show the cameras at a few of the windows."""
    chosen = np.unique(np.linspace(0, len(found.step) - 1, _FRAMES).round().astype(int))
    tiles = []
    for row in chosen:
        images = {name: np.asarray(image[row]) for name, image in found.raw.image.items()}
        height = max(image.shape[0] for image in images.values())
        pad = {n: np.pad(x, [(0, height - len(x)), (0, 0), (0, 0)]) for n, x in images.items()}
        tiles.append(np.pad(side_by_side(pad), [(0, 0), (0, 4), (0, 0)], constant_values=255))
    axes.imshow(np.concatenate(tiles, axis=1))
    axes.set_axis_off()
    times = ", ".join(f"{found.control_dt * found.step[row]:.1f}" for row in chosen)
    axes.set_title(f"{found.task[0]}, episode {found.episode[0]}, at {times} s", loc="left")
