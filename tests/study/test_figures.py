"""Figures plot the results, readable on light and dark pages."""

import xml.etree.ElementTree

from lorasp_jax.study import figures, tables
from tests.study import synthetic

BOOK = tables.Book(tuple(synthetic.results()), synthetic.results())


def test_figures_are_readable_on_light_and_dark_pages():
    for scheme, colors in figures.SCHEMES.items():
        text = figures.svg(figures.figure_1, BOOK, scheme)
        root = xml.etree.ElementTree.fromstring(text)
        assert root.tag.endswith("svg")
        assert colors["ink"] in text
        assert "<dc:date>" not in text
        assert "fill: #ffffff" not in text


def test_figures_show_the_results():
    axes = figures.figure_1(BOOK).axes[0]
    ranks = next(line for line in axes.lines if line.get_label() == "LoRA").get_xdata()
    assert list(ranks) == [2, 4, 8, 16, 32, 64]
    assert len(figures.figure_3(BOOK).axes) == 4
    panels = figures.figure_6(BOOK).axes
    assert len(panels) == 6
    boxes = synthetic.results()["pi0/multi/lora_sp/s0"]["measures"]["rank_boxes"]["vision"]
    assert len(panels[0].patches) == sum(len(layers) for layers in boxes.values())


def test_figure_4_with_a_seen_robot():
    """Drawn from shares of seen and unseen robots; layers that did not change are left out."""
    results = dict(synthetic.results())
    for backbone in ("pi0", "smolvla"):
        for seed in range(3):
            name = f"{backbone}/panda/full/s{seed}"
            results[name] = synthetic.result(name, ("press",), 8)
    figure = figures.figure_4(tables.Book(tuple(results), results))
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == [
        "Panda, seen",
        "PiPER, unseen",
    ]
