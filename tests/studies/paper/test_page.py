"""The page is made from results alone, the same bytes every time, and names what is missing."""

import re

import pytest

from lorasp_jax.evaluation.metrics import position_bias
from lorasp_jax.extras.study import claims, results
from lorasp_jax.extras.study.__main__ import main
from studies.paper import page, published
from tests import ROOT
from tests.studies.paper import synthetic

RESULTS = ROOT / "docs" / "study.json"


@pytest.fixture(scope="module")
def complete():
    return page.page(synthetic.study(), synthetic.cells())


def section(text: str, title: str) -> str:
    return text.partition(f"## {title}")[2].partition("\n## ")[0]


def rebuild(file, tmp_path, scale="accelerator"):
    """Rebuild page and figures with the command that the page names; return them by path."""
    options = ["--results", str(file), "--no-run", "--out", str(tmp_path / "runs")]
    assert main(["--config", str(synthetic.PAPER), "--scale", scale, *options]) == 0
    assert not (tmp_path / "runs").exists()
    files = [file, file.parent / "study.md", *(file.parent / "figures").glob("study_*")]
    return {path.relative_to(file.parent): path.read_bytes() for path in files}


def test_one_command_rebuilds_page_and_figures(tmp_path):
    some = {n: r for n, r in synthetic.cells("smoke").items() if n != "pi0/multi/lora_r4/s1"}
    for found in (synthetic.cells("smoke"), some):
        book = []
        for name in ("a", "b"):
            (tmp_path / name).mkdir(exist_ok=True)
            results.write(tmp_path / name / "study.json", "paper_smoke", found)
            book.append(rebuild(tmp_path / name / "study.json", tmp_path, "smoke"))
        assert book[0] == book[1]
        assert {path.name for path in book[0]} >= {"study.md", "study_6_dark.svg"}
        assert results.load(tmp_path / "a/study.json").keys() == found.keys()


@pytest.mark.slow
def test_the_committed_page_is_made_from_the_committed_results(tmp_path):
    docs = RESULTS.parent
    (tmp_path / "docs/figures").mkdir(parents=True)
    for path in (RESULTS, *(docs / "figures").glob("rank_map_*.gif")):
        (tmp_path / "docs" / path.relative_to(docs)).write_bytes(path.read_bytes())
    files = rebuild(tmp_path / "docs/study.json", tmp_path)
    committed = [RESULTS, docs / "study.md", *(docs / "figures").glob("study_*")]
    assert {path.relative_to(docs) for path in committed} == files.keys()
    for path in committed:
        made, there = (
            figure_version(b) for b in (files[path.relative_to(docs)], path.read_bytes())
        )
        if made == there:  # other versions of Matplotlib draw other bytes
            assert files[path.relative_to(docs)] == path.read_bytes(), path


def test_committed_success_does_not_depend_on_the_position_in_a_batch():
    for name, cell in results.load(RESULTS).items():
        outcomes = [[o == "1" for o in text] for text in cell["outcomes"].values()]
        assert not position_bias(outcomes), name


def figure_version(content):
    return re.findall(rb"Matplotlib v[\d.]+", content)


def test_all_results_fit_in_the_file(tmp_path):
    results.write(tmp_path / "study.json", "paper", synthetic.cells(episodes=256))
    assert (tmp_path / "study.json").stat().st_size < 0.8 * results.MAX_BYTES


def test_claims_come_first(complete):
    assert complete.index("## Claims") < complete.index("## Tables") < complete.index("## Costs")
    rows = re.findall(r"^\| (\d+) \| ", complete.partition("###")[0], re.MULTILINE)
    assert rows == [str(number) for number in range(1, 11)]
    assert "| training, all tasks | 5,000 steps of 128 samples, AdamW |" in complete
    assert "{" not in complete.replace("{rank}", "?")


def test_limits_come_before_the_claims(complete):
    assert complete.index("## What this study cannot say") < complete.index("## Claims")
    limits = section(complete, "What this study cannot say")
    assert "pictures have 64 x 64 pixels" in limits
    assert "scripts, 512 per task;" in limits
    count = sum(len(tests) for claim in synthetic.study().claims for tests in claim.tests.values())
    assert f"- The {count} tests behind the verdicts are not corrected" in limits


def test_results_speak_before_limits_and_after_table_1():
    """If LoRA-SP does not gain, the page says so at the top, and why below Table I."""
    found = dict(synthetic.cells())
    for name, cell in synthetic.cells().items():
        if "/multi/lora_sp/" in name:
            found[name] = cell | {"outcomes": found[name.replace("_sp", "_r64")]["outcomes"]}
    text = page.page(synthetic.study(), found)
    assert "**Main result: LoRA-SP shows no gain" in text.partition("## What this study")[0]
    assert "### Why LoRA-SP does not gain here" in text.partition("### Table I:")[2]
    assert text.index("### Why LoRA-SP") < text.index("### Table II")


def test_fixed_numbers_in_the_text(complete):
    """Those of the paper and of the rule for weak verdicts."""
    towers = published.cell("smolvla/multi/lora_sp", 64)["towers"]
    assert towers == [84, 35, 34]
    assert f"exceeds {sum(towers) / 3:.0f}, the plain mean of" in complete
    assert f"bounds that are {100 * claims.MARGIN:g} points easier or harder" in complete
    assert f"for ranks and shares, {100 * claims.MARGIN:g} % of the largest" in complete
    assert "for LoRA of rank r, that of the paper's rank 2r, since R is 64 here" in complete


def test_the_page_has_no_times_of_runs_that_shared_gpus(complete):
    costs = section(complete, "Costs")
    assert "samples/s" not in costs
    assert "seconds" not in costs
    assert "[ms]" not in complete
    assert "takes 108 s" in costs


def test_rank_maps_are_shown_if_there_are_any(tmp_path):
    (tmp_path / "figures").mkdir()
    page.write(synthetic.study("smoke"), {}, tmp_path)
    text = (tmp_path / "study.md").read_text()
    assert "is a film of an episode" not in text
    (tmp_path / "figures/rank_map_pi0.gif").touch()
    page.write(synthetic.study("smoke"), {}, tmp_path)
    text = (tmp_path / "study.md").read_text()
    assert "| π0 |\n| --- |\n| ![Rank map of π0](figures/rank_map_pi0.gif) |\n" in text
    assert "A [rank map](runs.md#rank-maps) is a film of an episode" in text


def test_missing_cells_are_counted():
    found = dict(synthetic.cells("smoke"))
    del found["pi0/multi/lora_r4/s1"]
    text = page.page(synthetic.study("smoke"), found)
    assert "**Unfinished: 9 of 10 runs so far.**" in text
    assert "| one policy for all tasks | 5 of 6 |" in text
    assert "1 of 2 runs so far" in section(text, "Tables")
    assert "3 of 4 runs so far" in section(text, "Claims")


def test_nothing_is_missing(complete):
    assert "so far" not in complete.replace("runs for this", "")
    assert "Unfinished" not in complete


def test_a_study_without_results():
    text = page.page(synthetic.study(), {})
    assert f"0 of {len(synthetic.study().cells)} runs so far" in text
    assert "holds**" not in section(text, "Claims").partition("A claim is tested")[0]
    assert "*Figure 1. Multi-task" in text
    assert "**0 of 48 runs so far.**" in text


@pytest.mark.parametrize("scale", ["accelerator", "smoke"])
def test_every_cell_may_be_missing(scale):
    """With half of the cells, some of each table are missing."""
    found = {n: r for i, (n, r) in enumerate(synthetic.cells(scale).items()) if i % 2}
    assert "so far" in page.page(synthetic.study(scale), found)
