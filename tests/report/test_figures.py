"""Figures plot the given values."""

import numpy as np
import pytest

from lorasp_jax.report import figures

TASKS = {
    "press": {
        "before": {"success": 0.0, "episodes": 64, "ci95": [0.0, 0.0566]},
        "after": {"success": 0.75, "episodes": 64, "ci95": [0.632, 0.84]},
    },
    "pick_place": {
        "before": {"success": 0.1, "episodes": 64, "ci95": [0.05, 0.2]},
        "after": {"success": 0.5, "episodes": 64, "ci95": [0.38, 0.62]},
    },
}
ROWS = [
    {"step": 2.0, "task": 1.0, "active_rank/vision": 6.0},
    {"step": 4.0, "task": 0.5, "active_rank/vision": 4.0, "spectral": 0.1},
]


def test_success():
    (axes,) = figures.success({"tasks": TASKS}).axes
    np.testing.assert_allclose([bar.get_width() for bar in axes.patches], [0, 75, 10, 50])
    ends = [line.get_xdata() for line in axes.lines]
    np.testing.assert_allclose(ends, [[0, 5.66], [63.2, 84], [5, 20], [38, 62]])
    assert [label.get_text() for label in axes.get_yticklabels()] == ["press", "pick_place"]
    assert "after 75 %" in {text.get_text() for text in axes.texts}


def test_success_over_steps():
    rows = [{"step": 2.0, "success/press": 0.25}, {"step": 4.0, "task": 1.0}]
    rows += [{"step": 6.0, "success/press": 0.5, "success/pour": 1.0}]
    (axes,) = figures.success_over_steps(rows).axes
    curves = {line.get_label(): line.get_xydata().tolist() for line in axes.lines}
    assert curves == {"press": [[2, 0.25], [6, 0.5]], "pour": [[6, 1]]}


def test_losses_are_plotted_where_recorded():
    task, auxiliary = figures.losses(ROWS).axes
    np.testing.assert_array_equal(task.lines[0].get_xydata(), [[2, 1], [4, 0.5]])
    assert [line.get_label() for line in auxiliary.lines] == ["spectral"]
    np.testing.assert_array_equal(auxiliary.lines[0].get_xydata(), [[4, 0.1]])
    assert not figures.losses([{"step": 2.0, "task": 1.0}]).axes[1].lines


def test_active_rank_and_bank_size():
    (axes,) = figures.active_rank(ROWS, 8).axes
    assert [line.get_ydata()[0] for line in axes.lines] == [6, 8]


def test_one_dot_per_layer():
    layers = {"vision": {"fc1": [1.0, 2.0], "fc2": [3.0]}, "language": {}, "action": {"fc1": [4.0]}}
    panels = figures.layer_ranks(layers, 8).axes
    assert [axes.get_title(loc="left") for axes in panels] == ["vision", "action"]
    dots = [dot for points in panels[0].collections for dot in points.get_offsets().tolist()]
    assert dots == [[0, 1], [0, 2], [1, 3]]


def test_histogram_shows_percentages_of_tokens():
    panels = figures.rank_histogram({"vision": [0, 3, 1], "action": [0, 0, 0]}).axes
    for axes, percentages in zip(panels, ([0, 75, 25], [0, 0, 0]), strict=True):
        assert [bar.get_height() for bar in axes.patches] == percentages
        assert [bar.get_center()[0] for bar in axes.patches] == pytest.approx([0, 1, 2])


def test_svg_is_deterministic():
    first, second = (figures.svg(figures.success({"tasks": TASKS})) for _ in range(2))
    assert first == second
