"""Verdicts follow from the interval's place relative to the bound."""

import dataclasses

import pytest

from lorasp_jax.extras.study.statistics import Estimate
from studies.paper import criteria
from studies.paper.criteria import Criterion, Outcome, judge, verdict


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
    ],
)
def test_verdict_of_a_claim(verdicts, expected):
    assert verdict([Outcome(v, Estimate(0, 0, 0)) for v in verdicts]) == expected


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
    ],
)
@pytest.mark.parametrize(("scale", "side"), [(1.0, "above"), (64.0, "above"), (1.0, "below")])
def test_weak_verdicts_change_with_the_bound(intervals, expected, scale, side):
    tests, outcomes = [], []
    for ends in intervals:
        sign = 1 if side == "above" else -1
        interval = sorted(sign * scale * end for end in ends)
        test = dataclasses.replace(criterion(side, 0.0), maximum=scale)
        tests.append(test)
        outcomes.append(judge(test, {"cell": (0.0, *interval)}))
    assert criteria.is_weak(tests, outcomes) is expected
