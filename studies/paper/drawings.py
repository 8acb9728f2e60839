"""All figures of the study's page: which results they need, their captions and files."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from lorasp_jax.base.writing import write_text
from studies.paper import figure_style, figures, task_figures
from studies.paper.book import BACKBONES, Book


@dataclass(frozen=True)
class Drawing:
    """A figure.

    Attributes:
        draw: draws it for the backbones of a book.
        needs: returns the methods that it shows for a backbone, such as "pi0/multi/lora_r2".
        title: its name and what it shows.
        caption: how to read it.
        alt: what a reader who cannot see it should know.
    """

    draw: Callable[[Book], Figure]
    needs: Callable[[Book, str], list[str]]
    title: str
    caption: str
    alt: str


def _lora(book: Book, backbone: str, *kinds: str) -> list[str]:
    ranks = book.ranks(backbone, "multi")
    return [f"{backbone}/{kind}/lora_r{rank}" for kind in kinds for rank in ranks]


def _lora_sp(_: Book, backbone: str) -> list[str]:
    return [f"{backbone}/multi/lora_sp"]


def _table_2(book: Book, backbone: str) -> list[str]:
    kinds = ("single", "multi")
    return _lora(book, backbone, *kinds) + [f"{backbone}/{kind}/full" for kind in kinds]


DRAWINGS = {
    "1": Drawing(
        figures.figure_1,
        lambda book, b: [*_lora(book, b, "multi"), f"{b}/multi/full", *_lora_sp(book, b)],
        "Figure 1. Multi-task success relative to full fine-tuning, against rank",
        "The further left a point reaches the dotted line, the less rank the method needs; bands "
        "and bars are 95 % intervals, and the paper's ranks are scaled from R = 128 to {rank}. "
        "LoRA-SP's point is at the number of directions that a token uses; it stores all {rank}.",
        alt="LoRA's success as a line over ranks, LoRA-SP's as a point at its mean active rank, "
        "and a horizontal line at 100 %.",
    ),
    "3": Drawing(
        figures.figure_3,
        _table_2,
        "Figure 3. LoRA's success against rank, with one policy per task and one for all",
        "Above, the mean over tasks; below, how much tasks differ, corrected for the noise of "
        "finite samples and at least 0; bands are 95 % intervals.",
        alt="Lines of LoRA's success and of its standard deviation over tasks, against rank, for "
        "one task and for all.",
    ),
    "4": Drawing(
        figures.figure_4,
        lambda _, b: [f"{b}/multi/full", f"{b}/panda/full"],
        "Figure 4. Rank of full fine-tuning's updates, for a robot that the base has seen and for "
        "one that it has not",
        "The higher a box, the more of its singular values a layer's update needs for 99 % of its "
        "energy; boxes are quartiles over layers and seeds, whiskers go from minimum to maximum.",
        alt="For vision, language and action, a box of shares from 0 to 1 for the Panda, and one "
        "for the PiPER.",
    ),
    "6": Drawing(
        figures.figure_6,
        _lora_sp,
        "Figure 6. LoRA-SP's active rank over the tokens of held-out demonstrations",
        "For each kind of layer, dots are the medians of its layers, the bar is the middle half of "
        "tokens, averaged over layers and seeds, and the line goes from minimum to maximum.",
        alt="For each kind of linear layer in vision, language and action, the spread of active "
        "ranks from 0 to R.",
    ),
    "directions": Drawing(
        task_figures.shared_directions,
        _lora_sp,
        "Figure A. Which directions tasks share in LoRA-SP",
        "The further right of its ring a dot lies, the more two tasks share; dots and rings are "
        "means over seeds, thick lines span the seeds.",
        alt="For each pair of tasks and each module, a dot for the overlap of directions, and a "
        "ring for what chance gives.",
    ),
    "gradients": Drawing(
        task_figures.gradients,
        task_figures.gradient_methods,
        "Figure B. Cosines of gradients after multi-task training",
        "The closer a dot is to its ring, the less two tasks differ; dots and rings are means over "
        "pairs and seeds, thick lines span the seeds.",
        alt="For each method, a dot for the cosine between two tasks, and a ring for that between "
        "two batches of one task.",
    ),
}
"""Figures by the name of their files; those of the paper have its numbers."""


def write(book: Book, folder: Path) -> None:
    """Write the figures into `folder`/figures; delete those that no backbone has the results for.

    A figure shows the backbones for which it has all results.
    """
    for name, drawn in DRAWINGS.items():
        complete = [b for b in book.backbones if not book.missing(*drawn.needs(book, b))]
        texts = figure_style.svgs(drawn.draw, book.of(complete)) if complete else {}
        for scheme in figure_style.INKS:
            path = folder / "figures" / _file(name, scheme)
            if scheme in texts:
                write_text(path, texts[scheme])
            else:
                path.unlink(missing_ok=True)


def markdown(book: Book, name: str) -> str:
    """Return a figure with its caption, and how many runs it lacks."""
    drawn = DRAWINGS[name]
    needs = {b: drawn.needs(book, b) for b in book.backbones}
    missing = {b: text for b, names in needs.items() if (text := book.missing(*names))}
    caption = f"*{drawn.title}. {drawn.caption.format(rank=book.rank)}*"
    if len(missing) == len(needs):
        return f"{caption} **{book.missing(*itertools.chain(*needs.values()))}.**\n"
    lacks = "".join(f" **{BACKBONES[b]}: {text}.**" for b, text in missing.items())
    dark, light = (f"figures/{_file(name, scheme)}" for scheme in ("dark", "light"))
    return (
        f'<picture>\n  <source media="(prefers-color-scheme: dark)" srcset="{dark}">\n'
        f'  <img alt="{drawn.alt}" src="{light}">\n</picture>\n\n{caption}{lacks}\n'
    )


def _file(name: str, scheme: str) -> str:
    return f"study_{name}_{scheme}.svg"
