"""Verdicts on the page, and how much is missing for the others."""

import re

import pytest

from lorasp_jax.study import verdicts
from lorasp_jax.study.book import Book
from lorasp_jax.study.claims import judge_all
from tests.study import synthetic

CLAIMS = synthetic.study().claims
TESTED = {b: sum(b in claim.tests for claim in CLAIMS) for b in ("pi0", "smolvla")}
"""Number of claims that the study tests."""
NAMES = tuple(cell.name for cell in synthetic.study().cells)


def shown(make, results):
    book = Book(NAMES, results)
    return make(CLAIMS, book, judge_all(CLAIMS, results)).replace("\u00a0", " ")


def rows(table):
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[2:]]


@pytest.fixture(scope="module")
def some():
    """Results that only suffice for claims 1 and 8 on π0."""
    kept = ("pi0/multi/lora_sp/", "pi0/multi/lora_r64/", "smolvla/multi/lora_sp/s0")
    return {n: r for n, r in synthetic.results().items() if n.startswith(kept)}


def test_claims_are_counted_by_verdict(some):
    number = TESTED["smolvla"]
    first, second = shown(verdicts.summary, some).splitlines()
    assert first.startswith(f"- π0: of {TESTED['pi0']} claims, **2 hold** (1, 8), ")
    assert " await their runs** (2, 3, 4, " in first
    assert second.startswith(f"- SmolVLA: of {number} claims, **{number} await their runs** (1, ")
    one = {n: r for n, r in some.items() if "lora_r64" not in n}
    assert shown(verdicts.summary, one).startswith(
        f"- π0: of {TESTED['pi0']} claims, **1 holds** (8), "
    )


def test_claims_say_how_many_runs_there_are(some):
    table = rows(shown(verdicts.table, some))
    assert [row[0] for row in table] == [str(number) for number in range(1, 11)]
    assert table[0][2:4] == ["**holds**", "1 of 6 runs so far"]
    assert table[1][2] == "3 of 6 runs so far"
    assert table[5][2:4] == ["–", "1 of 6 runs so far"]
    assert table[8][2] == "3 of 12 runs so far"


def test_numbers_of_both_backbones(some):
    table = rows(shown(verdicts.numbers, some))
    assert table[0][:3] == ["1", "LoRA-SP minus LoRA with r = 64", "above 0 points"]
    assert table[0][3].endswith("] (+23.3): holds")
    assert table[0][4] == "1 of 6 runs so far (+31.7)"
    assert ["6", "success with the spectral loss minus without", "above −3 points", "–"] in [
        row[:4] for row in table
    ]


def test_the_highest_rank_is_beside_claim_3(some):
    assert shown(lambda _, book, __: verdicts.highest_rank(book), some) == ""
    text = shown(lambda _, book, __: verdicts.highest_rank(book), synthetic.results())
    assert re.search(
        r"reaches, in %, \d+\.\d \[.*\] \(72\.0\) on π0 and .*\(69\.2\) on SmolVLA", text
    )


def test_shares_and_ranks_have_three_digits():
    table = rows(shown(verdicts.numbers, synthetic.results()))
    shares = [row[3] for row in table if row[0] == "5"]
    assert all(re.match(r"\+0\.\d{3} \[", share) for share in shares)


def test_reasons_are_given_once():
    lines = verdicts.reasons(CLAIMS).splitlines()
    assert lines[0].startswith("- claims 1, 4, ")
    assert len(set(lines)) == len(lines)
