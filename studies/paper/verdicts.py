"""The claims on the study's page: verdicts, and the numbers behind them."""

from collections.abc import Sequence
from typing import get_args

from lorasp_jax.extras.study import page
from lorasp_jax.extras.study.page import BACKBONES, NONE
from studies.paper.criteria import Claim, Criterion, Judged, Outcome, Verdict, is_weak
from studies.paper.criteria import verdict as verdict_of


def blocks(claims: Sequence[Claim], judged: Judged) -> dict[str, str]:
    """Return all tables by the names of their places in the page."""
    return {
        "verdicts": summary(claims, judged),
        "claims": table(claims, judged),
        "numbers": numbers(claims, judged),
        "reasons": reasons(claims),
    }


def summary(claims: Sequence[Claim], judged: Judged) -> str:
    """Return the numbers of the claims by backbone and verdict, and of the weak verdicts."""
    verdicts = get_args(Verdict)
    rows = []
    for backbone, title in BACKBONES.items():
        tested = [claim for claim in claims if backbone in claim.tests]
        row = [
            [c.number for c in tested if _verdict(judged, c, backbone) == name] for name in verdicts
        ] + [[c.number for c in tested if _weak(judged, c, backbone)]]
        rows.append([title, *(", ".join(map(str, numbers)) or NONE for numbers in row)])
    return page.table(["", *verdicts, "of these, weak"], rows)


def table(claims: Sequence[Claim], judged: Judged) -> str:
    """Return the table of all claims."""
    rows = []
    for claim in claims:
        found = [_shown(claim, judged, backbone) for backbone in BACKBONES]
        rows.append([str(claim.number), claim.statement, *found, claim.paper])
    return page.table(["", "claim", *BACKBONES.values(), "in the paper"], rows)


def _shown(claim: Claim, judged: Judged, backbone: str) -> str:
    """Return a claim's verdict and whether it is weak; a dash if no cells of the study test it."""
    if backbone not in claim.tests:
        return NONE
    weak = " (weak)" * _weak(judged, claim, backbone)
    return f"**{_verdict(judged, claim, backbone)}**{weak}"


def _weak(judged: Judged, claim: Claim, backbone: str) -> bool:
    return is_weak(claim.tests[backbone], judged[claim.number, backbone])


def _verdict(judged: Judged, claim: Claim, backbone: str) -> str:
    return verdict_of(judged[claim.number, backbone])


def numbers(claims: Sequence[Claim], judged: Judged) -> str:
    """Return the table of all tests."""
    rows = []
    for claim in claims:
        found: dict[tuple[str, str], dict[str, str]] = {}
        for backbone, tests in claim.tests.items():
            for test, outcome in zip(tests, judged[claim.number, backbone], strict=True):
                row = found.setdefault((test.measure, _bound(test)), {})
                row[backbone] = _measured(test, outcome)
        rows += [
            [str(claim.number), *test, *(row.get(b, NONE) for b in BACKBONES)]
            for test, row in found.items()
        ]
    return page.table(["claim", "number", "must be", *BACKBONES.values()], rows)


def reasons(claims: Sequence[Claim]) -> str:
    """Return the table of the reasons for all bounds."""
    found = dict[tuple[str, str], dict[int, None]]()
    for claim in claims:
        for test in (test for tests in claim.tests.values() for test in tests):
            found.setdefault((_bound(test), test.reason), {})[claim.number] = None
    rows = [[", ".join(map(str, numbers)), *reason] for reason, numbers in found.items()]
    return page.table(["claims", "must be", "why"], rows)


def _measured(test: Criterion, outcome: Outcome) -> str:
    """Return the estimate, the paper's number and the verdict of a test."""
    paper = "" if test.paper is None else f" ({_number(test.paper, test)})"
    value, low, high = outcome.estimate
    ends = f"[{_end(low, test)}, {_end(high, test)}]"
    return f"{_number(value, test)} {ends}{paper}: {outcome.verdict}"


def _end(value: float, test: Criterion) -> str:
    """Return the end of an interval, with one more digit if it would look like the bound."""
    text = _number(value, test)
    return _number(value, test, 1) if text == _number(test.bound, test) else text


def _bound(test: Criterion) -> str:
    unit = f" {test.unit}" if test.unit else ""
    scale = 100 if test.unit else 1
    return f"{test.side} {test.bound * scale:g}{unit}".replace("-", "−")


def _number(value: float, test: Criterion, more: int = 0) -> str:
    """Return a number in a criterion's unit, differences with a sign; `more` digits than usual."""
    if test.unit == "%":
        return f"{100 * value:.{1 + more}f}"
    if test.unit:
        return page.signed(100 * value, 1 + more)
    return f"{value + 0.0:+#.{3 + more}g}".replace("-", "−")
