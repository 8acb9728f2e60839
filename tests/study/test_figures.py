"""Figures plot the results, readable on light and dark pages."""

import xml.etree.ElementTree

from lorasp_jax.study import figure_style, figures
from lorasp_jax.study.book import Book
from tests.study import synthetic

BOOK = Book(tuple(synthetic.results()), synthetic.results())


def test_figures_are_readable_on_light_and_dark_pages():
    for scheme, colors in figure_style.SCHEMES.items():
        text = figure_style.svg(figures.figure_1, BOOK, scheme)
        root = xml.etree.ElementTree.fromstring(text)
        assert root.tag.endswith("svg")
        assert colors["ink"] in text
        assert "<dc:date>" not in text
        assert "fill: #ffffff" not in text


def test_success_against_rank():
    axes = figures.figure_1(BOOK).axes[0]
    lines = {line.get_label(): line for line in axes.lines}
    assert list(lines["LoRA"].get_xdata()) == [2, 4, 8, 16, 32, 64]
    assert list(lines["LoRA, paper"].get_xdata()) == [4, 8, 16, 32, 64]
    assert list(lines["LoRA-SP, paper"].get_xdata()) == [38]
    assert len(figures.figure_3(BOOK).axes) == 4


def test_a_box_for_each_layer():
    panels = figures.figure_6(BOOK).axes
    assert len(panels) == 6
    for axes, tower in zip(panels[3:], ("vision", "language", "action"), strict=True):
        boxes = BOOK.measures("smolvla/multi/lora_sp", "rank_boxes")[0][tower]
        assert len(axes.patches) == sum(len(layers) for layers in boxes.values())
    labels = [text.get_text() for text in panels[5].get_xticklabels()]
    assert labels[:3] == ["q", "k", "v"]
    assert "time_in" in labels


def test_seen_and_unseen_robots():
    figure = figures.figure_4(BOOK)
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == [
        "Panda, seen",
        "PiPER, unseen",
    ]
