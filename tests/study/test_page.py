"""The page is made from results alone, the same bytes every time, and names what is missing."""

import re

import pytest

from lorasp_jax.study import page
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


def test_missing_cells_are_counted():
    results = dict(synthetic.results("smoke"))
    del results["pi0/multi/lora_r4/s1"]
    text = page.page(synthetic.study("smoke"), results)
    assert "9 of its 10 runs" in text
    assert "| LoRA, r = 4 |" in text
    assert "not yet run (1 of 2)" in section(text, "Tables")
    assert "not yet run (1 of 4)" in section(text, "Claims")


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
