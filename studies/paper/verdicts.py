"""The claims on the study's page: verdicts, and the numbers behind them."""

from collections.abc import Iterable

from lorasp_jax.extras.study.claims import Claim, Criterion, Judged, Outcome, is_weak, verdict
from studies.paper.book import BACKBONES, NONE, Book, markdown, signed

_WORDS = {
    "holds": ("holds", "hold"),
    "does not hold": ("does not hold", "do not hold"),
    "cannot be told": ("cannot be told", "cannot be told"),
    "not yet run": ("awaits its runs", "await their runs"),
}
"""Verdicts, and the words for one and for several claims."""


def summary(claims: tuple[Claim, ...], book: Book, judged: Judged) -> str:
    """Count the claims with each verdict and name the weak ones, by backbone."""
    lines = []
    for backbone in book.backbones:
        verdicts = {c.number: _verdict(judged, c, backbone) for c in claims}
        weak = [str(c.number) for c in claims if _weak(judged, c, backbone)]
        parts = []
        for name, words in _WORDS.items():
            if numbers := [number for number, found in verdicts.items() if found == name]:
                text = f"**{len(numbers)} {words[len(numbers) > 1]}**"
                parts.append(f"{text} ({', '.join(map(str, numbers))})")
        tested = len(claims) - [*verdicts.values()].count(NONE)
        line = f"- {BACKBONES[backbone]}: of {tested} claims, {', '.join(parts)}"
        lines.append(line + (f"; [weak](#claims): {', '.join(weak)}" if weak else ""))
    return "\n".join(lines)


def table(claims: tuple[Claim, ...], book: Book, judged: Judged) -> str:
    """Return the table of all claims."""
    rows = []
    for claim in claims:
        found = [_shown(claim, book, judged, backbone) for backbone in book.backbones]
        rows.append([str(claim.number), claim.statement, *found, claim.paper])
    titles = [BACKBONES[backbone] for backbone in book.backbones]
    return markdown(["", "claim", *titles, "in the paper"], rows)


def _shown(claim: Claim, book: Book, judged: Judged, backbone: str) -> str:
    """Return a claim's verdict and whether it is weak, or how many of its runs there are."""
    found = _verdict(judged, claim, backbone)
    if found == "not yet run":
        return book.missing_cells({n for test in claim.tests[backbone] for n in test.cells})
    if found == NONE:
        return found
    return f"**{found}**{' (weak)' * _weak(judged, claim, backbone)}"


def _weak(judged: Judged, claim: Claim, backbone: str) -> bool:
    """Return whether a claim has a verdict on a backbone, but a weak one."""
    if _verdict(judged, claim, backbone) in (NONE, "not yet run"):
        return False
    return is_weak(claim.tests[backbone], judged[claim.number, backbone])


def _verdict(judged: Judged, claim: Claim, backbone: str) -> str:
    """Return a claim's verdict on a backbone; a dash if no cells of the study test it."""
    outcomes = judged.get((claim.number, backbone))
    return verdict(outcomes) if outcomes else NONE


def numbers(claims: tuple[Claim, ...], book: Book, judged: Judged) -> str:
    """Return the table of all tests."""
    rows = []
    for claim in claims:
        found: dict[tuple[str, str], dict[str, str]] = {}
        for backbone, tests in claim.tests.items():
            for test, outcome in zip(tests, judged[claim.number, backbone], strict=True):
                row = found.setdefault((test.measure, _bound(test)), {})
                row[backbone] = _measured(test, outcome)
        rows += [
            [str(claim.number), *test, *(row.get(b, NONE) for b in book.backbones)]
            for test, row in found.items()
        ]
    titles = [BACKBONES[backbone] for backbone in book.backbones]
    return markdown(["claim", "number", "must be", *titles], rows)


def reasons(claims: Iterable[Claim]) -> str:
    """Return a list of the reasons for all bounds."""
    found = dict[str, list[int]]()
    for claim in claims:
        for test in (test for tests in claim.tests.values() for test in tests):
            numbers = found.setdefault(f"{_bound(test)}: {test.reason}", [])
            numbers += [claim.number] if claim.number not in numbers else []
    return "".join(
        f"- claim{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers))}, {reason}\n"
        for reason, numbers in found.items()
    )


def _measured(test: Criterion, outcome: Outcome) -> str:
    """Return the estimate, the paper's number and the verdict of a test."""
    paper = "" if test.paper is None else f" ({_number(test.paper, test)})"
    if outcome.estimate is None:
        return f"{outcome.cells - outcome.missing} of {outcome.cells} runs so far{paper}"
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
        return signed(100 * value, 1 + more)
    return f"{value + 0.0:+#.{3 + more}g}".replace("-", "−")
