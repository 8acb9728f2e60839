"""The page is made from results alone, the same bytes every time, and names what is missing."""

import re
import xml.etree.ElementTree

import pytest

from lorasp_jax.study import figures, page, tables
from tests.study import synthetic


@pytest.fixture(scope="module")
def complete():
    return page.page(synthetic.study(), synthetic.results())


def section(text: str, title: str) -> str:
    return text.partition(f"## {title}")[2].partition("\n## ")[0]


def test_built_twice_the_files_are_equal(tmp_path):
    book = []
    for name in ("a", "b"):
        (tmp_path / name / "figures").mkdir(parents=True)
        page.write(synthetic.study("smoke"), synthetic.results("smoke"), tmp_path / name)
        files = sorted(path for path in (tmp_path / name).rglob("*") if path.is_file())
        book.append({path.relative_to(tmp_path / name): path.read_bytes() for path in files})
    assert book[0] == book[1]
    assert any(path.name == "study.md" for path in book[0])
    assert any(path.name == "study_6_dark.svg" for path in book[0])


def test_claims_come_first(complete):
    assert complete.index("## Claims") < complete.index("## Tables") < complete.index("## Costs")
    rows = re.findall(r"^\| (\d+) \| ", section(complete, "Claims"), re.MULTILINE)
    assert rows == [str(number) for number in range(1, 11)]
    assert "{" not in complete.replace("{rank}", "?")


def test_tables_stand_beside_the_papers_numbers(complete):
    row = next(line for line in complete.splitlines() if line.startswith("| LoRA-MoE, top-1 |"))
    ours = synthetic.results()
    pour = [ours[f"pi0/multi/lora_moe_top1/s{seed}"]["outcomes"]["pour"] for seed in range(3)]
    mean = 100 * sum(o.count("1") for o in pour) / sum(map(len, pour))
    assert f"| {mean:.1f} (13.3) |" in row
    assert row.endswith("(23.3) |")
    assert "(32)" in row


def test_missing_cells_are_counted():
    results = dict(synthetic.results())
    del results["pi0/multi/dora/s1"], results["smolvla/multi/lora_sp_eta_0.7/s0"]
    text = page.page(synthetic.study(), results)
    dora = next(line for line in text.splitlines() if line.startswith("| DoRA"))
    assert "not yet run (1 of 3)" in dora
    assert "LoRA-SP, η = 0.7 | – | (53.3)" in text
    assert "349 of its 351 runs" in text


def test_a_study_without_results():
    text = page.page(synthetic.study(), {})
    assert "0 of its 351 runs" in text
    assert "**not yet run**" in text
    assert "holds**" not in section(text, "Claims").partition("A claim is tested")[0]
    assert "Figure 1: not yet run (48 of 48)" in text


@pytest.mark.parametrize("scale", ["accelerator", "smoke"])
def test_every_cell_may_be_missing(scale):
    """With half of the cells, some of each table are missing."""
    results = {n: r for i, (n, r) in enumerate(synthetic.results(scale).items()) if i % 2}
    assert "not yet run" in page.page(synthetic.study(scale), results)


def test_figures_are_readable_on_light_and_dark_pages():
    book = tables.Book(tuple(synthetic.results()), synthetic.results())
    for scheme, colors in figures.SCHEMES.items():
        text = figures.svg(figures.figure_1, book, scheme)
        root = xml.etree.ElementTree.fromstring(text)
        assert root.tag.endswith("svg")
        assert colors["ink"] in text
        assert "<dc:date>" not in text
        assert "fill: #ffffff" not in text


def test_figures_show_the_results():
    book = tables.Book(tuple(synthetic.results()), synthetic.results())
    axes = figures.figure_1(book).axes[0]
    ranks = next(line for line in axes.lines if line.get_label() == "LoRA").get_xdata()
    assert list(ranks) == [2, 4, 8, 16, 32, 64]
    assert len(figures.figure_3(book).axes) == 4
    panels = figures.figure_6(book).axes
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


def test_best_rates_are_bold(complete):
    rows = section(complete, "Learning rates").splitlines()
    pilots = [row for row in rows if row.startswith("| LoRA-SP |")]
    assert len(pilots) == 2
    assert all(row.count("**") == 2 for row in pilots)
