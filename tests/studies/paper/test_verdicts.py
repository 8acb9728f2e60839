"""Verdicts on the page, and how much is missing for the others."""

import re

import pytest

from lorasp_jax.extras.study.claims import Claim, Criterion, judge_all
from lorasp_jax.extras.study.statistics import Estimate
from studies.paper import verdicts
from studies.paper.book import Book
from tests.studies.paper import synthetic

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


def claim_on(*interval, unit="points"):
    """A claim on π0 with one test, whose number must lie above 0.95."""
    estimate = lambda results: Estimate(*interval)  # noqa: E731
    test = Criterion("number", ("pi0/x",), estimate, "above", 0.95, "reason", unit)
    return Claim(1, "claim", "paper", {"pi0": (test,)})


@pytest.mark.parametrize(("low", "weak"), [(0.953, True), (0.956, False), (0.0, False)])
def test_weak_verdicts_are_marked(low, weak):
    claims, results = (claim_on(0.97, low, 0.98),), {"pi0/x": {}}
    book, judged = Book(("pi0/x",), results), judge_all(claims, results)
    cell = rows(verdicts.table(claims, book, judged))[0][2]
    assert cell.endswith("** (weak)") == weak
    assert verdicts.summary(claims, book, judged).endswith("; [weak](#claims): 1") == weak
    assert "weak" not in verdicts.summary(claims, Book(("pi0/x",), {}), judge_all(claims, {}))


@pytest.mark.parametrize(
    ("low", "unit", "shown"),
    [(0.9498, "%", "94.98"), (0.9502, "points", "+95.02"), (0.9494, "%", "94.9")],
)
def test_an_interval_that_ends_near_the_bound_does_not_seem_to_end_on_it(low, unit, shown):
    claims, results = (claim_on(0.97, low, 0.98, unit=unit),), {"pi0/x": {}}
    book, judged = Book(("pi0/x",), results), judge_all(claims, results)
    assert f" [{shown}, " in rows(verdicts.numbers(claims, book, judged))[0][3].replace(
        "\u00a0", " "
    )


def test_shares_and_ranks_have_three_digits():
    table = rows(shown(verdicts.numbers, synthetic.results()))
    shares = [row[3] for row in table if row[0] == "5"]
    assert all(re.match(r"\+0\.\d{3} \[", share) for share in shares)


def test_reasons_are_given_once():
    lines = verdicts.reasons(CLAIMS).splitlines()
    assert lines[0].startswith("- claims 1, 4, ")
    assert len(set(lines)) == len(lines)
