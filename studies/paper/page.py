"""What is generated of the study's page, README.md, from the results alone: tables and figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lorasp_jax.base.writing import write_text
from lorasp_jax.extras.study.study import Study
from studies.paper import tables, verdicts
from studies.paper.book import Book
from studies.paper.criteria import Claim, judge_all


def blocks(
    claims: Sequence[Claim], _: Study, results: Mapping[str, Any], folder: Path
) -> dict[str, str]:
    """Write the figures into `folder`/figures; return the page's tables by name."""
    from studies.paper import figure_style, figures, task_figures  # a run draws nothing

    book = Book(results)
    drawings = figures.DRAWINGS | task_figures.DRAWINGS
    (folder / "figures").mkdir(exist_ok=True)
    for name, draw in drawings.items():
        for scheme, text in figure_style.svgs(draw, book).items():
            write_text(folder / "figures" / f"{name}_{scheme}.svg", text)
    judged = judge_all(claims, results)
    return tables.blocks(book) | verdicts.blocks(claims, judged)
