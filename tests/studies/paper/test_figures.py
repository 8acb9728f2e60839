"""Figures plot the results, readable on light and dark pages."""

import xml.etree.ElementTree

import numpy as np
import pytest
from matplotlib.patches import PathPatch

from studies.paper import figure_style, figures
from studies.paper.book import Book
from tests.studies.paper import synthetic

BOOK = Book(tuple(synthetic.results()), synthetic.results())


def test_figures_are_readable_on_light_and_dark_pages():
    texts = figure_style.svgs(figures.figure_1, BOOK)
    assert texts.keys() == figure_style.INKS.keys()
    for scheme, text in texts.items():
        root = xml.etree.ElementTree.fromstring(text)
        assert root.tag.endswith("svg")
        assert [ink for ink in figure_style.INKS.values() if ink in text] == [
            figure_style.INKS[scheme]
        ]
        assert "<dc:date>" not in text
        assert "fill: #ffffff" not in text


def test_all_figures_fill_the_page():
    draw = (figures.figure_1, figures.figure_3, figures.figure_4, figures.figure_6)
    for book in (BOOK, BOOK.of(["pi0"])):
        assert {f(book).get_figwidth() for f in draw} == {figure_style.WIDTH}


def test_success_against_rank():
    figure = figures.figure_1(BOOK)
    axes = figure.axes[0]
    lines = {line.get_label(): line for line in axes.lines}
    assert np.asarray(lines["LoRA"].get_xdata()).tolist() == [2, 4, 8, 16, 32, 64]
    assert np.asarray(lines["LoRA, paper (ranks halved)"].get_xdata()).tolist() == [
        4,
        8,
        16,
        32,
        64,
    ]
    assert np.asarray(lines["LoRA-SP, paper (ranks halved)"].get_xdata()).tolist() == [38]
    assert axes.get_ylim()[0] == 0
    (legend,) = figure.legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts[-1] == "full fine-tuning"
    assert len(texts) == 5


def test_mean_and_deviation_over_tasks():
    figure = figures.figure_3(BOOK)
    assert len(figure.axes) == 4
    entries = [text.get_text().split(",")[0] for text in figure.legends[0].get_texts()]
    assert entries == ["LoRA", "LoRA", "full fine-tuning", "full fine-tuning"]
    lines = {line.get_label(): np.asarray(line.get_ydata()) for line in figure.axes[0].lines}
    rates = 100 * BOOK.outcomes("pi0/single/lora_r8").mean((0, 2))
    assert lines["LoRA, one policy per task"][2] == pytest.approx(rates.mean())
    full = 100 * BOOK.outcomes("pi0/multi/full").mean()
    assert np.asarray(lines["full fine-tuning, one for all"]).tolist() == pytest.approx(
        [full, full]
    )
    below = {line.get_label(): np.asarray(line.get_ydata()) for line in figure.axes[2].lines}
    assert below["one policy per task"][2] < rates.std()


def test_a_row_for_each_kind_of_layer():
    panels = figures.figure_6(BOOK).axes
    assert len(panels) == 6
    labels = [text.get_text() for text in panels[4].get_yticklabels()]
    assert labels[:5] == ["state", "action_in", "time_in", "time_out", "q"]
    assert labels[-1] == "action_out"
    cells = BOOK.measures("pi0/multi/lora_sp", "rank_boxes")
    layers = np.array([cell["action"]["q_proj"] for cell in cells])
    (line, dots) = (line for line in panels[4].lines if np.asarray(line.get_ydata())[0] == 4)
    assert np.asarray(line.get_xdata()).tolist() == [layers[..., 0].min(), layers[..., 4].max()]
    assert np.asarray(dots.get_xdata()).tolist() == pytest.approx(layers[..., 2].mean(0))


def test_layers_have_one_order():
    assert figures._in_order(["new", "o_proj", "q_proj", "o_proj"]) == ["q_proj", "o_proj", "new"]


def test_seen_and_unseen_robots():
    figure = figures.figure_4(BOOK)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "Panda (seen), new scene",
        "PiPER (unseen)",
    ]
    assert figure.axes[0].get_ylim() == (0, 1)
    boxes = [patch for patch in figure.axes[0].patches if isinstance(patch, PathPatch)]
    shares = np.array([box.get_path().vertices[:, 1] for box in boxes])
    assert 0.3 < shares.min() < shares.max() < 0.7
