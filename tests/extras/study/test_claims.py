"""Verdicts follow from the interval's place relative to the bound; missing cells are counted."""

import dataclasses

import pytest

from lorasp_jax.extras.study import claims
from lorasp_jax.extras.study.claims import Criterion, Outcome, judge, verdict
from lorasp_jax.extras.study.statistics import Estimate
from tests.studies.paper import synthetic

CLAIMS = synthetic.study().claims
TESTS = [
    pytest.param(test, id=f"{claim.number}-{backbone}-{index}")
    for claim in CLAIMS
    for backbone, tests in claim.tests.items()
    for index, test in enumerate(tests)
]


def criterion(side, bound):
    estimate = lambda results: Estimate(*results["cell"])  # noqa: E731
    return Criterion("number", ("cell",), estimate, side, bound, "reason")


@pytest.mark.parametrize(
    ("side", "interval", "expected"),
    [
        ("above", (0.1, 0.3), "holds"),
        ("above", (-0.3, -0.1), "does not hold"),
        ("above", (-0.1, 0.3), "cannot be told"),
        ("above", (0.0, 0.3), "cannot be told"),
        ("below", (0.1, 0.3), "does not hold"),
        ("below", (-0.3, -0.1), "holds"),
        ("below", (-0.1, 0.3), "cannot be told"),
    ],
)
def test_verdict_of_a_test(side, interval, expected):
    outcome = judge(criterion(side, 0.0), {"cell": (0.2, *interval)})
    assert outcome.verdict == expected
    assert outcome.estimate == (0.2, *interval)


@pytest.mark.parametrize(
    ("verdicts", "expected"),
    [
        (["holds", "holds"], "holds"),
        (["holds", "cannot be told"], "cannot be told"),
        (["cannot be told", "does not hold"], "does not hold"),
        (["holds", "not yet run"], "not yet run"),
        (["not yet run", "does not hold"], "does not hold"),
    ],
)
def test_verdict_of_a_claim(verdicts, expected):
    assert verdict([Outcome(v, None, 0, 1) for v in verdicts]) == expected


@pytest.mark.parametrize(
    ("intervals", "expected"),
    [
        ([(0.004, 0.3)], True),  # holds, but not with a bound of 0.005
        ([(0.006, 0.3)], False),
        ([(-0.3, -0.004)], True),
        ([(-0.3, -0.006)], False),
        ([(-0.004, 0.3)], True),
        ([(-0.3, 0.004)], True),
        ([(-0.3, 0.3)], False),
        ([(-0.3, -0.004), (-0.3, -0.1)], False),  # the other one decides
        ([(-0.3, 0.3), (0.004, 0.3)], False),
        ([(0.1, 0.3), (0.004, 0.3)], True),
        ([(-0.3, -0.1), None], False),
    ],
)
@pytest.mark.parametrize(("scale", "side"), [(1.0, "above"), (64.0, "above"), (1.0, "below")])
def test_weak_verdicts_change_with_the_bound(intervals, expected, scale, side):
    tests, outcomes = [], []
    for ends in intervals:
        sign = 1 if side == "above" else -1
        interval = sorted(sign * scale * end for end in ends) if ends else ()
        test = dataclasses.replace(criterion(side, 0.0), maximum=scale)
        tests.append(test)
        outcomes.append(judge(test, {"cell": (0.0, *interval)} if ends else {}))
    assert claims.is_weak(tests, outcomes) is expected


def test_all_ten_claims():
    assert [claim.number for claim in CLAIMS] == list(range(1, 11))
    judged = claims.judge_all(CLAIMS, synthetic.results())
    found = {key: verdict(outcomes) for key, outcomes in judged.items()}
    assert found[1, "pi0"] == "holds"
    assert found[9, "smolvla"] == "holds"
    assert "not yet run" not in found.values()


class Recording(dict):
    """Results that record which cells are read."""

    def __init__(self, results):
        super().__init__(results)
        self.read = set()

    def __getitem__(self, name):
        self.read.add(name)
        return super().__getitem__(name)


@pytest.mark.parametrize("test", TESTS)
def test_tests_read_the_cells_that_they_name(test):
    results = Recording(synthetic.results())
    estimate = judge(test, results).estimate
    assert results.read == set(test.cells)
    assert estimate.low <= estimate.value <= estimate.high or "deviation" in test.measure
    assert test.reason.strip()
    assert test.paper is None or abs(test.paper) < 100


@pytest.mark.parametrize("test", TESTS)
def test_missing_cells_are_counted(test):
    others = test.cells[1:]
    results = {name: synthetic.results()[name] for name in others}
    assert judge(test, results) == Outcome("not yet run", None, 1, len(test.cells))
    assert judge(test, {}).missing == len(test.cells)


def test_verdicts_turn_with_the_results():
    """If LoRA is given LoRA-SP's episodes and the other way round, claim 1 no longer holds."""
    results = synthetic.results()
    swapped = dict(results)
    for seed in range(3):
        a, b = (f"pi0/multi/{method}/s{seed}" for method in ("lora_sp", "lora_r64"))
        swapped |= {a: results[b], b: results[a]}
    (test,) = CLAIMS[0].tests["pi0"]
    assert judge(test, swapped).verdict == "does not hold"
    estimates = [judge(test, each).estimate for each in (results, swapped)]
    assert estimates[0].value == pytest.approx(-estimates[1].value)
