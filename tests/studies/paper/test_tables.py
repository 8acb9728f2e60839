"""Tables show our numbers beside the paper's, and count missing cells."""

import pytest

from studies.paper import naming, published, tables
from studies.paper.book import Book
from tests.studies.paper import synthetic

NAMES = tuple(cell.name for cell in synthetic.study().cells)
BOOK = Book(NAMES, synthetic.results())


def row(table: str, method: str) -> list[str]:
    lines = table.replace("\u00a0", " ").splitlines()
    line = next(line for line in lines if line.startswith(f"| {method} |"))
    return [cell.strip() for cell in line.split("|")[1:-1]]


def test_success_beside_the_papers():
    cells = row(tables.table_1(BOOK, "pi0"), "LoRA-MoE, top-1")
    ours = synthetic.results()
    pour = [ours[f"pi0/multi/lora_moe_top1/s{seed}"]["outcomes"]["pour"] for seed in range(3)]
    mean = 100 * sum(o.count("1") for o in pour) / sum(map(len, pour))
    assert cells[4] == f"{mean:.1f} (13.3)"
    assert cells[1].endswith("(9.2)")
    assert cells[2].endswith("(32)")
    assert cells[-1].endswith("] (23.3)")


def test_tasks_keep_the_papers_order():
    results = dict(synthetic.results())
    for seed in range(3):
        name = f"pi0/multi/dora/s{seed}"
        outcomes = {"open_pot": "1111", "pour": "1110", "press": "1100", "pick_place": "1000"}
        results[name] = {**results[name], "outcomes": outcomes}
    cells = row(tables.table_1(Book(NAMES, results), "pi0"), "DoRA, r = 64")
    assert cells[3:7] == ["100.0", "75.0", "50.0", "25.0"]


def test_methods_of_table_1():
    base, *lines = tables.table_1(BOOK, "smolvla").splitlines()[2:]
    assert base == "| base, not adapted | – | – | 25.0 | 25.0 | 25.0 | 25.0 | 25.0 |"
    methods = [line.split("|")[1].replace("\u00a0", " ").strip() for line in lines]
    assert methods[0] == "LoRA, r = 64"
    assert methods[5:7] == ["LoRA-SP", "DoRA, r = 64"]
    assert len(methods) == 9


def test_ranks_by_module():
    cells = row(tables.table_3(BOOK, "smolvla"), "LoRA-SP without spectral loss")
    assert [cell.split()[-1] for cell in cells[1:4]] == ["(83)", "(107)", "(57)"]
    assert tables.table_3(BOOK, "pi0") == tables.table_4(BOOK, "pi0") == ""


def test_energy_targets_are_in_order():
    lines = tables.table_4(BOOK, "smolvla").replace("\u00a0", " ").splitlines()[2:]
    names = [f"LoRA-SP, η = {eta}" for eta in (0.5, 0.7, 0.8, 0.9, 0.99)]
    assert [line.split("|")[1].strip() for line in lines] == names


def test_pruning():
    cells = row(tables.pruning(BOOK, "smolvla"), "LoRA-SP, η = 0.7")
    assert cells[1] == "40.0 → 25.0"
    rates = [BOOK.outcomes(f"smolvla/multi/lora_sp_eta_0.7{x}").mean() for x in ("", "_pruned")]
    for text, rate in zip(cells[2:], rates, strict=True):  # and no time
        assert text.startswith(f"{100 * rate:.1f} [")
    assert tables.pruning(BOOK, "pi0") == ""


def test_missing_cells():
    results = {name: r for name, r in synthetic.results().items() if "/dora/s1" not in name}
    book = Book(NAMES, results)
    assert row(tables.table_1(book, "pi0"), "DoRA, r = 64")[-1] == "2 of 3 runs so far"
    assert row(tables.costs(book, "pi0"), "DoRA, r = 64")[1] == "2 of 3 runs so far"
    del results["smolvla/single/full/pour/s2"]
    cells = row(tables.table_2(Book(NAMES, results)), "full fine-tuning")
    assert cells[3] == "11 of 12 runs so far (93.3)"
    assert cells[4].endswith("] (86.7)")


def test_a_table_without_a_finished_method_is_one_line():
    results = {n: r for n, r in synthetic.results().items() if n == "pi0/multi/lora_sp/s0"}
    book = Book(NAMES, results)
    assert tables.table_1(book, "pi0") == "1 of 27 runs so far.\n"
    assert "0 of 96 runs so far." in tables.table_2_by_task(book, "smolvla")


def test_base_without_results():
    results = {n: r for n, r in synthetic.results().items() if n != "pi0/multi/lora_sp/s0"}
    cells = row(tables.table_1(Book(NAMES, results), "pi0"), "base, not adapted")
    assert cells[-1] == "0 of 1 runs so far"


def test_ranks_of_both_backbones():
    cells = row(tables.table_2(BOOK), "LoRA-SP")
    ours = [BOOK.outcomes(f"smolvla/{kind}/lora_sp").mean() for kind in ("single", "multi")]
    for text, rate, paper in zip(cells[3:], ours, (93.3, 91.7), strict=True):
        assert text.startswith(f"{100 * rate:.1f} [")
        assert text.endswith(f"] ({paper})")
    assert tables.table_2(Book(("pi0/multi/full/s0",), {})) == ""


def test_costs():
    cells = row(tables.costs(BOOK, "pi0"), "LoRA, r = 64")
    assert cells[1:] == ["5.76 M", "2.1", "5.59"]
    assert "cut" not in tables.costs(BOOK, "pi0")


def test_best_rate_is_bold():
    results = dict(synthetic.results())
    for rate, episodes in (("0.0003", "10"), ("0.001", "11"), ("0.003", "00")):
        results[f"pi0/pilot/full/{rate}"] = {"outcomes": {"press": episodes}}
    del results["smolvla/pilot/full/0.001"]
    table = tables.rates(Book(NAMES, results))
    cells = row(table, "full fine-tuning")
    assert cells[1:] == ["50.0", "**100.0**", "0.0", "2 of 3 runs so far", "–", "–"]
    assert row(table, "method")[1:3] == ["π0, 0.0003", "π0, 0.001"]


@pytest.mark.parametrize(
    ("prefix", "mean"),
    [("pi0/multi/lora_sp", 83.3), ("smolvla/single/lora_r64", 91.7), ("pi0/multi/lora_r16", 41.7)],
)
def test_the_papers_numbers(prefix, mean):
    """The means that the paper's text and tables give."""
    assert 100 * published.rates(prefix, 64).mean() == pytest.approx(mean, abs=0.06)


def test_the_papers_rates_are_fifteenths():
    """12, 13, 12 and 13 of 15 have a mean of 83.33 %; the rounded rates have 83.35."""
    assert published.rates("pi0/multi/full", 64).mean() == pytest.approx(50 / 60)


def test_the_paper_has_no_number():
    assert published.rates("pi0/multi/lora_r2", 64) is None
    assert published.cell("pi0/multi/dora", 64) == {}


def test_every_method_has_a_label():
    for name in NAMES:
        assert naming.label(name.split("/")[2], 64)


def test_both_robots_of_figure_4():
    lines = tables.robots(BOOK).splitlines()[2:]
    assert [line.partition(" | 25.0 | ")[0] for line in lines] == [
        f"| {backbone}, {robot}"
        for backbone in ("π0", "SmolVLA")
        for robot in ("Panda, seen", "PiPER, unseen")
    ]
    results = {n: r for n, r in synthetic.results().items() if n != "pi0/panda/full/s0"}
    line = tables.robots(Book(NAMES, results)).splitlines()[2]
    assert line == "| π0, Panda, seen | 0 of 1 runs so far | 2 of 3 runs so far |"
    smoke = synthetic.results("smoke")
    assert tables.robots(Book(tuple(smoke), smoke)) == ""
