"""A book gives the results of methods, and says which of their runs are missing."""

import pytest

from studies.paper.book import Book, markdown
from tests.studies.paper import synthetic

NAMES = tuple(cell.name for cell in synthetic.study().cells)
BOOK = Book(NAMES, synthetic.results())


def test_missing_runs_are_counted():
    book = Book(NAMES, {n: r for n, r in synthetic.results().items() if "/dora/s1" not in n})
    assert book.missing("pi0/multi/lora_sp") == ""
    assert book.missing("pi0/multi/dora") == "2 of 3 runs so far"
    assert book.missing("pi0/multi/lora_sp", "pi0/multi/dora") == "5 of 6 runs so far"
    assert book.missing("pi0/multi/none") == "The study has no runs for this"
    assert Book(NAMES, {}).missing_cells(NAMES[:4]) == "0 of 4 runs so far"


def test_a_part_of_the_backbones():
    part = BOOK.of(["smolvla"])
    assert part.backbones == ["smolvla"]
    assert part.rank == BOOK.rank == 64
    assert len(part.cells("smolvla/multi/dora")) == 3
    assert not part.cells("pi0/multi/dora")


def test_measures_of_all_seeds():
    pairs = BOOK.measures("pi0/multi/lora_sp", "direction_overlap")
    assert len(pairs) == 3
    assert len(pairs[0]) == 6
    assert len(BOOK.measures("pi0/multi/lora_sp", "rank_boxes")) == 3


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("1.5 [−1.0, +2.0] (3.0)", "1.5~[−1.0,~+2.0] (3.0)"),
        ("LoRA, r = 64, cut", "LoRA, r~=~64, cut"),
        ("below 95 %", "below 95~%"),
        ("83, 107, 57 (vision)", "83, 107, 57 (vision)"),
    ],
)
def test_numbers_do_not_break(text, shown):
    assert markdown(["a"], [[text]]) == f"| a |\n| --- |\n| {shown.replace('~', chr(0xA0))} |\n"
