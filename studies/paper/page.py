"""The page of the study of the paper, docs/study.md, from its results alone."""

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from lorasp_jax.base.writing import write_text
from lorasp_jax.config import Config
from lorasp_jax.extras.study.claims import judge_all
from lorasp_jax.extras.study.study import Cell, Study
from studies.paper import drawings, findings, notes, tables, verdicts
from studies.paper.book import BACKBONES, NONE, Book, markdown
from studies.paper.main_result import main_result
from studies.paper.no_gain import no_gain
from studies.paper.rank_text import where_rank_goes
from studies.paper.setup_table import setup_table

_TRAININGS = {
    "pilot": "learning rates",
    "multi": "one policy for all tasks",
    "single": "one policy per task",
    "panda": "the seen robot",
}
"""Kinds of cells, as the page calls them."""


def write(study: Study, results: Mapping[str, Any], folder: Path) -> None:
    """Write study.md and figures/study_*.svg into `folder`; the same results give the same bytes.

    Args:
        study: the study of the paper, at any scale.
        results: the content of cell.json by cell name, of the finished cells.
        folder: the page shows the rank maps in its figures/, named rank_map_<backbone>.gif.
    """
    (folder / "figures").mkdir(exist_ok=True)
    drawings.write(_book(study, results), folder)
    films = {path.name for path in (folder / "figures").glob("rank_map_*.gif")}
    write_text(folder / "study.md", page(study, results, films))


def page(study: Study, results: Mapping[str, Any], films: Collection[str] = ()) -> str:
    """Return the page in Markdown; `films` are the names of the rank maps in figures/."""
    book, config = _book(study, results), _config(study)
    template = Path(__file__).with_name("page.md").read_text()
    return template.format(
        rank=book.rank,
        setup=setup_table(book, config),
        image_size=config.image_size,
        demonstrations=config.data.episodes,
        films=_films(book, films),
        **_judged(study, book),
        **{sentences.__name__: sentences(book) for sentences in _SENTENCES},
        **_tables(book),
        **{f"figure_{name}": drawings.markdown(book, name) for name in drawings.DRAWINGS},
    )


def _judged(study: Study, book: Book) -> dict[str, str]:
    """Return what the page says about the claims, by its place in page.md."""
    claims, judged = study.claims, judge_all(study.claims, book.results)
    return {
        "missing": _missing(book),
        "progress": _progress(book),
        "size": _size(book),
        "summary": verdicts.summary(claims, book, judged),
        "verdicts": verdicts.table(claims, book, judged),
        "numbers": verdicts.numbers(claims, book, judged),
        "reasons": verdicts.reasons(claims),
        "tests": str(sum(map(len, judged.values()))),
    }


def _tables(book: Book) -> dict[str, str]:
    """Return the tables of results, by their places in page.md."""
    by_backbone = tables.table_1, tables.table_3, tables.table_4, tables.pruning, tables.costs
    return {
        "table_2": tables.table_2(book) or _NO_CELLS,
        "table_2_by_task": "\n".join(tables.table_2_by_task(book, b) for b in book.backbones),
        "robots": tables.robots(book) or _NO_CELLS,
        "rates": tables.rates(book),
        **{table.__name__: _by_backbone(book, table) for table in by_backbone},
    }


_NO_CELLS = "The study has no runs for this.\n"
_SENTENCES = (
    *(main_result, no_gain, where_rank_goes),
    *(notes.highest_rank, notes.without_state, notes.cost_of_cut),
    *(findings.experts, findings.edges, findings.pruned, findings.shared_directions),
    *(findings.gradients, findings.easy_tasks, findings.harder_scene, findings.adapter_sizes),
)
"""Each is named as its place in page.md."""


def _book(study: Study, results: Mapping[str, Any]) -> Book:
    return Book(tuple(cell.name for cell in study.cells), results)


def _missing(book: Book) -> str:
    """Say that runs are missing; "" if none is."""
    missing = book.missing_cells(book.names)
    return missing and (
        f"**Unfinished: {missing}.** Where a method lacks some of its seeds, the page has no "
        "number for it, but says how many of its runs there are.\n\n"
    )


def _progress(book: Book) -> str:
    """Count the runs by kind; "" if none is missing."""
    if not book.missing_cells(book.names):
        return ""
    rows = []
    for training, title in _TRAININGS.items():
        found = [
            [name in book.results for name in book.names if name.startswith(f"{b}/{training}/")]
            for b in book.backbones
        ]
        if any(found):
            rows.append([title, *(f"{sum(f)} of {len(f)}" if f else NONE for f in found)])
    return markdown(["runs so far", *(BACKBONES[b] for b in book.backbones)], rows) + "\n"


def _size(book: Book) -> str:
    """Say how large the study is, and what it has cost so far."""
    pilots = sum("/pilot/" in name for name in book.names)
    hours = f" {_hours(book)}" if book.results else ""
    return (
        f"It has {len(book.names)} policies, most trained, some cut or pruned from trained ones; "
        f"{pilots} only serve to choose learning rates.{hours}"
    )


def _config(study: Study) -> Config:
    """Return the config of a run for all tasks, the first that does not depend on results."""
    configs = (cell.config for cell in study.cells if isinstance(cell, Cell))
    return next(config for config in configs if isinstance(config, Config))


def _by_backbone(book: Book, table: Callable[[Book, str], str]) -> str:
    """Return a table for each backbone that has cells for it."""
    made = ((backbone, table(book, backbone)) for backbone in book.backbones)
    parts = [f"**{BACKBONES[backbone]}**\n\n{text}" for backbone, text in made if text]
    return "\n".join(parts) or _NO_CELLS


def _films(book: Book, names: Collection[str]) -> str:
    """Show the rank maps that exist; "" if there are none."""
    shown = [b for b in book.backbones if f"rank_map_{b}.gif" in names]
    images = [f"![Rank map of {BACKBONES[b]}](figures/rank_map_{b}.gif)" for b in shown]
    if not shown:
        return ""
    return (
        "A [rank map](runs.md#rank-maps) is a film of an episode in which each image patch is "
        f"tinted by its active rank.\n\n{markdown([BACKBONES[b] for b in shown], [images])}"
    )


def _hours(book: Book) -> str:
    seconds = sum(cell["seconds"]["total"] for cell in book.results.values())
    return (
        f"The {len(book.results)} finished runs took {seconds / 3600:.1f} hours in all, many of "
        "them on shared GPUs."
    )
