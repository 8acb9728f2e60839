"""The results of the paper's study so far, as its tables and figures read them."""

import dataclasses
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lorasp_jax.extras.study.statistics import Estimate
from studies.paper import naming
from studies.paper.naming import Seeds

BACKBONES = {"pi0": "π0", "smolvla": "SmolVLA"}
TASKS = {
    "open_pot": "open the pot",
    "pour": "pour",
    "press": "press",
    "pick_place": "pick and place",
}
"""Tasks and their titles, in the paper's order."""
NONE = "–"
_UNBREAKABLE = re.compile(r"(?<=\d,) (?=[+−\d][\d.]+\])|(?<==) | (?==)|(?<=\d) (?=[%M\[])")
"""Spaces within intervals, equations and quantities."""


@dataclass(frozen=True)
class Book:
    """The cells of a study and the results so far.

    Attributes:
        names: all cells.
        results: those that are finished.
    """

    names: tuple[str, ...]
    results: Mapping[str, Any]

    @property
    def backbones(self) -> list[str]:
        """The study's backbones, in order."""
        return list(dict.fromkeys(name.split("/")[0] for name in self.names))

    @property
    def rank(self) -> int:
        """R, LoRA's highest rank and the size of LoRA-SP's bank."""
        return max(self.ranks(self.backbones[0], "multi"), default=1)

    def of(self, backbones: Sequence[str]) -> "Book":
        """Return the part on some backbones."""
        names = tuple(name for name in self.names if name.split("/")[0] in backbones)
        return dataclasses.replace(self, names=names)

    def methods(self, backbone: str, training: str) -> list[str]:
        """Return the methods of a kind of training, in order."""
        parts = [name.split("/") for name in self.names]
        return list(dict.fromkeys(p[2] for p in parts if p[:2] == [backbone, training]))

    def ranks(self, backbone: str, training: str) -> list[int]:
        """Return LoRA's ranks in ascending order."""
        stems = self.methods(backbone, training)
        return sorted(int(m.removeprefix("lora_r")) for m in stems if m.startswith("lora_r"))

    def table_1_methods(self, backbone: str) -> list[str]:
        """Return the methods of Table I in the paper's order, then those beyond it."""
        first = f"lora_r{self.rank}"
        paper = [first, "lora_moe_top1", "lora_moe_weighted", "ada_lora", "full", "lora_sp"]
        own = self.methods(backbone, "multi")
        return [m for m in (*paper, "dora", "lora_same_rank", "lora_cut") if m in own]

    def cells(self, prefix: str) -> Seeds:
        """Return the cells of a method, such as "pi0/multi/lora_sp", by seed."""
        return naming.seeds(self.names, prefix)

    def missing(self, *prefixes: str) -> str:
        """Return "" if all cells of some methods are finished, else how many are."""
        methods = [naming.flat(self.cells(prefix)) for prefix in prefixes]
        if not methods or not all(methods):
            return "The study has no runs for this"
        return self.missing_cells([name for names in methods for name in names])

    def missing_cells(self, names: Iterable[str]) -> str:
        """Return "" if all of some cells are finished, else how many are."""
        finished = [name in self.results for name in names]
        if all(finished):
            return ""
        return f"{sum(finished)} of {len(finished)} runs so far"

    def complete(self, *methods: str) -> list[str]:
        """Return the backbones on which some methods, such as "multi/full", are finished."""
        return [b for b in self.backbones if not self.missing(*(f"{b}/{m}" for m in methods))]

    def outcomes(self, prefix: str) -> np.ndarray:
        """Return a method's episodes, bool `[S, T, N]`, tasks in order of name."""
        return naming.outcomes(self.results, self.cells(prefix))

    def tasks(self, prefix: str) -> list[str]:
        """Return a finished method's tasks in order of name."""
        return sorted({t for n in self.cells(prefix)[0] for t in self.results[n]["outcomes"]})

    def base(self, prefix: str) -> dict[str, float]:
        """Return the base's success by task, from a cell whose name begins with `prefix`.

        Empty if no finished one evaluated the base.
        """
        cells = [self.results[n] for n in self.names if n.startswith(prefix) and n in self.results]
        before = next((cell["before"] for cell in cells if "before" in cell), {})
        return {task: o.count("1") / len(o) for task, o in before.items()}

    def measures(self, prefix: str, name: str) -> list[Any]:
        """Return a measure of every cell of a finished method; see `measures.measures`."""
        return [self.results[cell]["measures"][name] for cell in naming.flat(self.cells(prefix))]

    def rank_boxes(self, prefix: str) -> dict[str, dict[str, np.ndarray]]:
        """Return the active ranks of a finished method: tower -> kind of layer -> `[S, L, 5]`.

        See `directions.rank_boxes` for the five numbers, `naming.by_depth` for the layers.
        """
        seeds = [
            {tower: naming.by_depth(linears) for tower, linears in cell.items()}
            for cell in self.measures(prefix, "rank_boxes")
        ]
        return {
            tower: {kind: np.array([seed[tower][kind] for seed in seeds], float) for kind in kinds}
            for tower, kinds in seeds[0].items()
        }

    def cosines(self, prefix: str) -> tuple[list[float], list[float]]:
        """Return mean cosines of the gradients of two tasks, and of two batches of one, by seed."""
        cells = [
            [(*pair.split("|"), towers["all"]) for pair, towers in cell.items()]
            for cell in self.measures(prefix, "gradient_cosine")
        ]
        two, one = (
            [float(np.mean([v for a, b, v in cell if (a == b) is same])) for cell in cells]
            for same in (False, True)
        )
        return two, one

    def mean(self, prefix: str, *path: str) -> float | None:
        """Return a number of the results, averaged over a method's cells; None if it is absent."""
        try:
            return float(np.mean(naming.per_seed(self.results, self.cells(prefix), *path)))
        except KeyError:
            return None


def markdown(headers: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table, in which intervals and other numbers do not break."""
    lines = [headers, ["---"] * len(headers), *rows]
    text = "".join(f"| {' | '.join(line)} |\n" for line in lines)
    return _UNBREAKABLE.sub("\u00a0", text)


def percent(estimate: Estimate) -> str:
    """Return a rate with its interval, such as "91.2 [89.0, 93.1]"."""
    value, low, high = (f"{100 * x:.1f}" for x in estimate)
    return f"{value} [{low}, {high}]"


def points(estimate: Estimate) -> str:
    """Return a difference of rates with its interval, such as "+1.2 points [−0.4, +2.9]"."""
    value, low, high = (signed(100 * x) for x in estimate)
    return f"{value} points [{low}, {high}]"


def signed(value: float, digits: int = 1) -> str:
    """Return a number with its sign, such as "−0.8"; zero has a plus."""
    return f"{round(value, digits) + 0.0:+.{digits}f}".replace("-", "−")


def on_each(texts: Mapping[str, str]) -> str:
    """Join texts by backbone, such as "1.2 on π0 and 3.4 on SmolVLA"."""
    return " and ".join(f"{text} on {BACKBONES[b]}" for b, text in texts.items())
