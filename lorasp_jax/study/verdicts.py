"""The claims on the study's page: verdicts, and the numbers behind them."""

from collections.abc import Iterable

from lorasp_jax.study import published, statistics
from lorasp_jax.study.book import BACKBONES, NONE, Book, markdown, percent
from lorasp_jax.study.claims import Claim, Criterion, Judged, Outcome, verdict

_WORDS = {
    "holds": ("holds", "hold"),
    "does not hold": ("does not hold", "do not hold"),
    "cannot be told": ("cannot be told", "cannot be told"),
    "not yet run": ("awaits its runs", "await their runs"),
}
"""Verdicts, and the words for one and for several claims."""


def summary(claims: tuple[Claim, ...], book: Book, judged: Judged) -> str:
    """Count the claims with each verdict, by backbone."""
    lines = []
    for backbone in book.backbones:
        verdicts = {c.number: _verdict(judged, c, backbone) for c in claims}
        parts = []
        for name, words in _WORDS.items():
            if numbers := [number for number, found in verdicts.items() if found == name]:
                text = f"**{len(numbers)} {words[len(numbers) > 1]}**"
                parts.append(f"{text} ({', '.join(map(str, numbers))})")
        tested = len(claims) - [*verdicts.values()].count(NONE)
        lines.append(f"- {BACKBONES[backbone]}: of {tested} claims, {', '.join(parts)}")
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
    """Return a claim's verdict, or how many of its runs there are."""
    found = _verdict(judged, claim, backbone)
    if found == "not yet run":
        return book.missing_cells({n for test in claim.tests[backbone] for n in test.cells})
    return found if found == NONE else f"**{found}**"


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


def highest_rank(book: Book) -> str:
    """Return how near LoRA with r = R comes to full fine-tuning, which claim 3 does not test."""
    parts = []
    methods = f"multi/lora_r{book.rank}", "multi/full"
    for backbone in book.complete(*methods):
        prefixes = [f"{backbone}/{method}" for method in methods]
        ratio = statistics.bootstrap(statistics.ratio, *map(book.outcomes, prefixes))
        rates = [r for p in prefixes if (r := published.rates(p, book.rank)) is not None]
        paper = f" ({100 * statistics.ratio(*rates):.1f})" if len(rates) == 2 else ""
        parts.append(f"{percent(ratio)}{paper} on {BACKBONES[backbone]}")
    if not parts:
        return ""
    return (
        "Claim 3 would also hold if no rank reached 95 % of full fine-tuning's success. LoRA with "
        f"r = {book.rank} reaches, in %, {' and '.join(parts)}.\n"
    )


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
    value, low, high = (_number(x, test) for x in outcome.estimate)
    return f"{value} [{low}, {high}]{paper}: {outcome.verdict}"


def _bound(test: Criterion) -> str:
    unit = f" {test.unit}" if test.unit else ""
    scale = 100 if test.unit else 1
    return f"{test.side} {test.bound * scale:g}{unit}".replace("-", "−")


def _number(value: float, test: Criterion) -> str:
    """Return a number in a criterion's unit, differences with a sign."""
    if test.unit == "%":
        return f"{100 * value:.1f}"
    points = round(100 * value, 1) + 0.0  # no minus zero
    text = f"{points:+.1f}" if test.unit else f"{value + 0.0:+#.3g}"
    return text.replace("-", "−")
