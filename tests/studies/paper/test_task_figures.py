"""Figures of what tasks share."""

import numpy as np
import pytest

from studies.paper import figure_style, task_figures
from studies.paper.book import Book
from tests.studies.paper import synthetic

BOOK = Book(tuple(synthetic.results()), synthetic.results())


def dots(axes, row):
    """Positions of the dots in a row, the filled one first."""
    found = [line for line in axes.lines if np.asarray(line.get_ydata()).tolist() == [row]]
    found.sort(key=lambda line: line.get_markerfacecolor() == "none")
    return [float(line.get_xdata()[0]) for line in found]


def test_shared_directions():
    first, axes = task_figures.shared_directions(BOOK).axes
    labels = [text.get_text() for text in first.get_yticklabels()]
    assert labels[0] == "open the pot + pour"
    assert labels[-1] == "press + pick and place"
    cells = BOOK.measures("smolvla/multi/lora_sp", "direction_overlap")
    values = np.array([cell["open_pot|press"]["language"] for cell in cells])
    assert dots(axes, 1) == pytest.approx(values.mean(0))


def test_lines_span_the_seeds_of_dots_and_rings():
    axes = task_figures.shared_directions(BOOK).axes[1]
    cells = BOOK.measures("smolvla/multi/lora_sp", "direction_overlap")
    values = np.array([cell["open_pot|press"]["language"] for cell in cells])
    on_row = [x for x in axes.lines if np.asarray(x.get_ydata()).tolist() == [1, 1]]
    ranges = [np.asarray(x.get_xdata()).tolist() for x in on_row if x.get_linewidth() > 1]
    assert sorted(ranges) == sorted([v.min(), v.max()] for v in values.T)


def test_rings_have_the_color_of_the_legend():
    for draw in (task_figures.shared_directions, task_figures.gradients):
        figure = draw(BOOK)
        rings = [x for x in figure.axes[0].lines if x.get_markerfacecolor() == "none"]
        assert {ring.get_color() for ring in rings} == {figure_style.FULL}
        assert figure.legends[0].get_texts()[-1].get_text() in (
            "by chance",
            "two batches of one task",
        )


def test_gradients_by_method():
    axes = task_figures.gradients(BOOK).axes[0]
    labels = [text.get_text() for text in axes.get_yticklabels()]
    assert labels[5] == "LoRA-SP"
    assert len(labels) == 8
    cosines = [
        [(pair.split("|"), towers["all"]) for pair, towers in cell.items()]
        for cell in BOOK.measures("pi0/multi/lora_sp", "gradient_cosine")
    ]
    other = np.mean([[c for (a, b), c in cell if a != b] for cell in cosines])
    same = np.mean([[c for (a, b), c in cell if a == b] for cell in cosines])
    assert dots(axes, 5) == pytest.approx([other, same])


def test_a_method_that_is_not_trained_has_no_gradients():
    methods = task_figures.gradient_methods(BOOK, "pi0")
    assert "pi0/multi/lora_cut" not in methods
    assert methods[0] == "pi0/multi/lora_r64"
