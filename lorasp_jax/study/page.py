"""The page of the study of the paper, docs/study.md, from its results alone."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from envs.datasets.writing import write_text
from lorasp_jax.study import figures, naming, tables
from lorasp_jax.study.claims import Claim, Criterion, Judged, Outcome, judge_all, verdict
from lorasp_jax.study.study import Study
from lorasp_jax.study.tables import BACKBONES, Book, markdown

_CAPTIONS = {
    1: "Multi-task success relative to full fine-tuning (dotted) against rank. Bands and bars are "
    "95 % intervals. The paper's points lie at the same fractions of R.",
    3: "Success of LoRA against rank, by task. The band spans the tasks.",
    4: "Share of the singular values that hold 99 % of the energy of full fine-tuning's update. "
    "Boxes are over layers and seeds.",
    6: "LoRA-SP's active rank over the tokens of held-out demonstrations, first seed. One box per "
    "layer, whiskers from minimum to maximum; layers of one kind stand side by side, in order of "
    "depth.",
}
_WORDS = {
    "holds": "hold",
    "does not hold": "do not hold",
    "cannot be told": "cannot be told",
    "not yet run": "await their runs",
}
"""Verdicts, and the words for several claims."""


def write(study: Study, results: Mapping[str, Any], folder: Path) -> None:
    """Write study.md and figures/study_*.svg into `folder`; the same results give the same bytes.

    Args:
        study: the study of the paper, at any scale.
        results: the content of cell.json by cell name, of the finished cells.
        folder: usually docs/. It must contain figures/.
    """
    book = Book(tuple(cell.name for cell in study.cells), results)
    for number, draw in figures.DRAWINGS.items():
        if not book.missing(*figures.needs(book, number)):
            for scheme in figures.SCHEMES:
                path = folder / "figures" / _figure_file(number, scheme)
                write_text(path, figures.svg(draw, book, scheme))
    write_text(folder / "study.md", page(study, results))


def page(study: Study, results: Mapping[str, Any]) -> str:
    """Return the page in Markdown."""
    book = Book(tuple(cell.name for cell in study.cells), results)
    judged = judge_all(study.claims, results)
    numbers, reasons = _numbers(study.claims, judged)
    made: dict[str, Callable[[Book, str], str]] = {
        "table_1": tables.table_1,
        "table_2": tables.table_2,
        "table_3": tables.table_3,
        "table_4": tables.table_4,
        "pruning": tables.pruning,
        "costs": tables.costs,
        "rates": tables.rates,
    }
    return (
        Path(__file__)
        .with_name("page.md")
        .read_text()
        .format(
            scale=_scale(book),
            summary=_summary(study.claims, book, judged),
            verdicts=_verdicts(study.claims, book, judged),
            rank=book.rank,
            numbers=numbers,
            reasons=reasons,
            figures="\n".join(_figure(book, number) for number in figures.DRAWINGS),
            total=_total(book),
            **{name: _by_backbone(book, table) for name, table in made.items()},
        )
    )


def _scale(book: Book) -> str:
    """Say how large the study is, and how much of it has run."""
    finished = sum(name in book.results for name in book.names)
    total = len(book.names)
    text = f"{finished} of its {total} runs (policies trained, or made from trained ones) are done"
    multi = naming.flat(book.cells(f"{book.backbones[0]}/multi/lora_sp"))
    done = [book.results[name]["outcomes"] for name in multi if name in book.results]
    if not done:
        return f"{text}."
    episodes = len(next(iter(done[0].values())))
    return f"{text}: {len(multi)} seeds, {episodes} episodes per task and seed."


def _summary(claims: tuple[Claim, ...], book: Book, judged: Judged) -> str:
    """Name the claims with each verdict, by backbone."""
    lines = []
    for backbone in book.backbones:
        found = {
            words: [c.number for c in claims if _verdict(judged, c, backbone) == name]
            for name, words in _WORDS.items()
        }
        parts = [f"{', '.join(map(str, n))} {words}" for words, n in found.items() if n]
        lines.append(f"- **{BACKBONES[backbone]}**: of the claims below, {'; '.join(parts)}.")
    return "\n".join(lines)


def _verdict(judged: Judged, claim: Claim, backbone: str) -> str:
    """Return a claim's verdict on a backbone; a dash if no cells of the study test it."""
    outcomes = judged.get((claim.number, backbone))
    return verdict(outcomes) if outcomes else tables.NONE


def _verdicts(claims: tuple[Claim, ...], book: Book, judged: Judged) -> str:
    """Return the table of all claims."""
    rows = []
    for claim in claims:
        found = (_verdict(judged, claim, backbone) for backbone in book.backbones)
        verdicts = [v if v == tables.NONE else f"**{v}**" for v in found]
        rows.append([str(claim.number), claim.statement, *verdicts, claim.paper])
    titles = [BACKBONES[backbone] for backbone in book.backbones]
    return markdown(["", "claim", *titles, "in the paper"], rows)


def _numbers(claims: tuple[Claim, ...], judged: Judged) -> tuple[str, str]:
    """Return the table of all tests, and a list of the reasons for their bounds."""
    rows, reasons = [], dict[str, list[int]]()
    for claim in claims:
        for backbone, tests in claim.tests.items():
            for test, outcome in zip(tests, judged[claim.number, backbone], strict=True):
                rows.append([f"{claim.number}, {BACKBONES[backbone]}", *_test(test, outcome)])
                numbers = reasons.setdefault(f"{_bound(test)}: {test.reason}", [])
                numbers += [claim.number] if claim.number not in numbers else []
    lines = [
        f"- claim{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers))}, {reason}\n"
        for reason, numbers in reasons.items()
    ]
    headers = ["claim", "number", "must be", "measured", "paper", "verdict"]
    return markdown(headers, rows), "".join(lines)


def _test(test: Criterion, outcome: Outcome) -> list[str]:
    """Return the row of a test."""
    paper = tables.NONE if test.paper is None else _number(test.paper, test)
    if outcome.estimate is None:
        missing = f"not yet run ({outcome.missing} of {outcome.cells})"
        return [test.measure, _bound(test), missing, paper, tables.NONE]
    value, low, high = (_number(x, test) for x in outcome.estimate)
    return [test.measure, _bound(test), f"{value} [{low}, {high}]", paper, outcome.verdict]


def _bound(test: Criterion) -> str:
    unit = f" {test.unit}" if test.unit else ""
    scale = 100 if test.unit else 1
    return f"{test.side} {test.bound * scale:g}{unit}".replace("-", "−")


def _number(value: float, test: Criterion) -> str:
    """Return a number in a criterion's unit, differences with a sign."""
    if test.unit == "%":
        return f"{100 * value:.1f}"
    rounded = round(value * (100 if test.unit else 1), 1) + 0.0  # no minus zero
    return f"{rounded:+.1f}".replace("-", "−")


def _by_backbone(book: Book, table: Callable[[Book, str], str]) -> str:
    """Return a table for each backbone that has cells for it."""
    made = ((backbone, table(book, backbone)) for backbone in book.backbones)
    parts = [f"**{BACKBONES[backbone]}**\n\n{text}" for backbone, text in made if text]
    return "\n".join(parts) or "The study has no cells for this.\n"


def _figure(book: Book, number: int) -> str:
    """Return a figure with its caption, or how many of its cells are missing."""
    caption = f"*Figure {number}. {_CAPTIONS[number]}*\n"
    if missing := book.missing(*figures.needs(book, number)):
        return f"Figure {number}: {missing}. {_CAPTIONS[number]}\n"
    dark, light = (f"figures/{_figure_file(number, scheme)}" for scheme in ("dark", "light"))
    return (
        f'<picture>\n  <source media="(prefers-color-scheme: dark)" srcset="{dark}">\n'
        f'  <img alt="Figure {number}" src="{light}">\n</picture>\n\n{caption}'
    )


def _figure_file(number: int, scheme: str) -> str:
    return f"study_{number}_{scheme}.svg"


def _total(book: Book) -> str:
    seconds = sum(cell["seconds"]["total"] for cell in book.results.values())
    return f"All {len(book.results)} finished runs together: {seconds / 3600:.1f} hours."
