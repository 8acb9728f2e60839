"""Claims of a paper, each with the tests that decide it, written down before the cells run.

A test estimates one number with its 95 % interval, and says on which side of a bound the number
must lie. It holds if the whole interval lies there, and does not hold if the whole interval lies on
the other side; otherwise the study cannot tell. A claim holds if all its tests do, and does not
hold if one of them does not.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from lorasp_jax.extras.study.statistics import Estimate
from lorasp_jax.extras.study.study import Results

Verdict = Literal["holds", "does not hold", "cannot be told"]
MARGIN = 0.005
"""By what share of a number's maximum a bound is moved to see whether a verdict is weak."""


@dataclass(frozen=True)
class Criterion:
    """One number that a claim is about.

    Attributes:
        measure: what the number is.
        cells: names of the cells that `estimate` reads.
        estimate: computes the number from the results of these cells.
        side: the side of the bound on which the number must lie.
        bound: the bound, in the unit of the number.
        reason: why this bound, in one line.
        unit: "points" (the number is a difference of rates, shown times 100), "%" (a ratio, shown
            times 100) or "" (shown as it is).
        paper: the same number from the paper's tables; None: the paper does not report it.
        maximum: the largest size that the number can have, in its own unit.
    """

    measure: str
    cells: tuple[str, ...]
    estimate: Callable[[Results], Estimate]
    side: Literal["above", "below"]
    bound: float
    reason: str
    unit: Literal["points", "%", ""] = "points"
    paper: float | None = None
    maximum: float = 1.0


@dataclass(frozen=True)
class Outcome:
    """What the results say about a test: a verdict, see the module, and the number."""

    verdict: Verdict
    estimate: Estimate


@dataclass(frozen=True)
class Claim:
    """A statement of a paper.

    Attributes:
        number: its number on the page.
        statement: the claim, as a sentence.
        paper: where and with which numbers the paper makes it.
        tests: the tests that decide it, by backbone.
    """

    number: int
    statement: str
    paper: str
    tests: Mapping[str, tuple[Criterion, ...]]


Judged = dict[tuple[int, str], list[Outcome]]
"""Outcomes of a claim's tests, by number and backbone."""


def judge_all(claims: Iterable[Claim], results: Results) -> Judged:
    """Judge all tests of all claims."""
    return {
        (claim.number, backbone): [judge(test, results) for test in tests]
        for claim in claims
        for backbone, tests in claim.tests.items()
    }


def judge(test: Criterion, results: Results) -> Outcome:
    """Compare a test's interval with its bound."""
    estimate = test.estimate(results)
    return Outcome(_compare(test, estimate), estimate)


def _compare(test: Criterion, estimate: Estimate, easier: float = 0.0) -> Verdict:
    """Compare an interval with a bound that is easier to meet by a share of the maximum."""
    sign = 1 if test.side == "below" else -1
    bound = test.bound + sign * easier * test.maximum
    above, below = estimate.low > bound, estimate.high < bound
    right, wrong = (above, below) if test.side == "above" else (below, above)
    return "holds" if right else "does not hold" if wrong else "cannot be told"


def verdict(outcomes: Iterable[Outcome]) -> Verdict:
    """Return the verdict on a claim from the outcomes of its tests."""
    found = [outcome.verdict for outcome in outcomes]
    order: tuple[Verdict, ...] = ("does not hold", "cannot be told", "holds")
    return next(name for name in order if name in found)


def is_weak(tests: Iterable[Criterion], outcomes: Sequence[Outcome]) -> bool:
    """Return whether bounds that are easier or harder to meet by `MARGIN` change a verdict."""
    pairs = [*zip(tests, outcomes, strict=True)]
    moved = [
        [dataclasses.replace(o, verdict=_compare(t, o.estimate, easier)) for t, o in pairs]
        for easier in (MARGIN, -MARGIN)
    ]
    return any(verdict(found) != verdict(outcomes) for found in moved)
