"""The generated parts of a study's README: tables between markers, in Markdown."""

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from lorasp_jax.base.writing import write_text
from lorasp_jax.extras.study import statistics
from lorasp_jax.extras.study.statistics import Estimate

NONE = "–"
BACKBONES = {"pi0": "π0", "smolvla": "SmolVLA"}
"""Backbone -> its name in tables and figures."""
_BLOCK = re.compile(r"(<!-- begin: ([\w ]+) -->\n).*?(<!-- end -->\n)", re.DOTALL)
_UNBREAKABLE = re.compile(r"(?<=\d,) (?=[+−\d][\d.]+\])|(?<==) | (?==)|(?<=\d) (?=[%M\[])")
"""Spaces within intervals, equations and quantities."""


def fill(path: Path, blocks: Mapping[str, str]) -> None:
    """Replace the generated parts of a page, `<!-- begin: NAME -->` to `<!-- end -->`.

    Raises:
        ValueError: the page lacks a part, or has one that `blocks` lacks.
    """
    text = path.read_text("utf-8")
    if different := {name for _, name, _ in _BLOCK.findall(text)} ^ blocks.keys():
        raise ValueError(f"{path} and its study have different parts: {', '.join(different)}")
    write_text(path, _BLOCK.sub(lambda m: f"{m[1]}\n{blocks[m[2]]}\n{m[3]}", text))


def table(headers: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table, in which intervals and other numbers do not break.

    Rows get dashes where they lack cells.
    """
    filled = ([*row, *[NONE] * (len(headers) - len(row))] for row in rows)
    lines = [headers, ["---"] * len(headers), *filled]
    text = "".join(f"| {' | '.join(line)} |\n" for line in lines)
    return _UNBREAKABLE.sub("\u00a0", text)


def success(outcomes: np.ndarray | None) -> str:
    """Return a method's success with its interval; a dash if it has not run."""
    return NONE if outcomes is None else percent(statistics.success(outcomes))


def difference(a: np.ndarray | None, b: np.ndarray | None) -> str:
    """Return a method's success minus another's with its interval; a dash if one has not run."""
    return NONE if a is None or b is None else points(statistics.difference(a, b))


def percent(estimate: Estimate) -> str:
    """Return a rate with its interval, such as "91.2 [89.0, 93.1]"."""
    value, low, high = (f"{100 * x:.1f}" for x in estimate)
    return f"{value} [{low}, {high}]"


def points(estimate: Estimate) -> str:
    """Return a difference of rates with its interval, such as "+1.2 [−0.4, +2.9]"."""
    value, low, high = (signed(100 * x) for x in estimate)
    return f"{value} [{low}, {high}]"


def signed(value: float, digits: int = 1) -> str:
    """Return a number with its sign, such as "−0.8"; zero has a plus."""
    return f"{round(value, digits) + 0.0:+.{digits}f}".replace("-", "−")
