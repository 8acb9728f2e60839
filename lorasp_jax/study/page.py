"""The page of the study of the paper, docs/study.md, from its results alone."""

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from envs.datasets.writing import write_text
from lorasp_jax.study import drawings, naming, tables, verdicts
from lorasp_jax.study.book import BACKBONES, NONE, Book, markdown
from lorasp_jax.study.claims import judge_all
from lorasp_jax.study.rank_text import where_rank_goes
from lorasp_jax.study.study import Study

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
        folder: usually docs/. It must contain figures/; the page shows the rank maps in it, named
            rank_map_<backbone>.gif.
    """
    drawings.write(_book(study, results), folder)
    films = {path.name for path in (folder / "figures").glob("rank_map_*.gif")}
    write_text(folder / "study.md", page(study, results, films))


def page(study: Study, results: Mapping[str, Any], films: Collection[str] = ()) -> str:
    """Return the page in Markdown; `films` are the names of the rank maps in figures/."""
    book = _book(study, results)
    judged = judge_all(study.claims, results)
    by_backbone: dict[str, Callable[[Book, str], str]] = {
        "table_1": tables.table_1,
        "table_2_by_task": tables.table_2_by_task,
        "table_3": tables.table_3,
        "table_4": tables.table_4,
        "pruning": tables.pruning,
        "costs": tables.costs,
    }
    return (
        Path(__file__)
        .with_name("page.md")
        .read_text()
        .format(
            rank=book.rank,
            missing=_missing(book),
            progress=_progress(book),
            size=_size(book),
            summary=verdicts.summary(study.claims, book, judged),
            verdicts=verdicts.table(study.claims, book, judged),
            numbers=verdicts.numbers(study.claims, book, judged),
            reasons=verdicts.reasons(study.claims),
            table_2=tables.table_2(book) or _NO_CELLS,
            robots=tables.robots(book) or _NO_CELLS,
            rates=tables.rates(book),
            where_rank_goes=where_rank_goes(book),
            films=_films(book, films),
            total=_total(book),
            **{f"figure_{name}": drawings.markdown(book, name) for name in drawings.DRAWINGS},
            **{name: _by_backbone(book, table) for name, table in by_backbone.items()},
        )
    )


_NO_CELLS = "The study has no runs for this.\n"


def _book(study: Study, results: Mapping[str, Any]) -> Book:
    return Book(tuple(cell.name for cell in study.cells), results)


def _missing(book: Book) -> str:
    """Say that runs are missing; "" if none is."""
    missing = book.missing_cells(book.names)
    return missing and (
        f"**Unfinished: {missing}.** The others wait for GPU time. Where a method lacks some of "
        "its seeds, the page has no number for it, but says how many of its runs there are.\n\n"
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
    """Say how large the study is."""
    text = f"It has {len(book.names)} runs: policies trained, or made from trained ones"
    multi = naming.flat(book.cells(f"{book.backbones[0]}/multi/lora_sp"))
    done = [book.results[name] for name in multi if name in book.results]
    if not done:
        return f"{text}."
    episodes = len(next(iter(done[0]["outcomes"].values())))
    optim, data = done[0]["config"]["optim"], done[0]["config"]["data"]
    return (
        f"{text}; {len(multi)} seeds, and {episodes} episodes per task and seed. A policy for all "
        f"tasks trains for {optim['steps']:,} steps of {optim['batch_size']} samples, on "
        f"{data['episodes']} demonstrations per task."
    )


def _by_backbone(book: Book, table: Callable[[Book, str], str]) -> str:
    """Return a table for each backbone that has cells for it."""
    made = ((backbone, table(book, backbone)) for backbone in book.backbones)
    parts = [f"**{BACKBONES[backbone]}**\n\n{text}" for backbone, text in made if text]
    return "\n".join(parts) or _NO_CELLS


def _films(book: Book, names: Collection[str]) -> str:
    """Show the rank maps that exist, and say how to make others."""
    shown = [b for b in book.backbones if f"rank_map_{b}.gif" in names]
    images = [f"![Rank map of {BACKBONES[b]}](figures/rank_map_{b}.gif)" for b in shown]
    films = f"{markdown([BACKBONES[b] for b in shown], [images])}\n" if shown else ""
    command = (
        f"python -m lorasp_jax.report rank-map runs/paper/{book.backbones[0]}/multi/lora_sp/s0"
    )
    return (
        f"{films}A rank map is a film of an episode in which each image patch is tinted by its "
        f"active rank: `{command}`.\n"
    )


def _total(book: Book) -> str:
    seconds = sum(cell["seconds"]["total"] for cell in book.results.values())
    return f"The times of all {len(book.results)} finished runs sum to {seconds / 3600:.1f} hours."
