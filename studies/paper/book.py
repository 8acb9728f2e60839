"""The results of the paper's study, as its tables and figures read them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from studies.paper import naming
from studies.paper.naming import Seeds

TASKS = {
    "open_pot": "open the pot",
    "pour": "pour",
    "press": "press",
    "pick_place": "pick and place",
}
"""Tasks and their titles, in the paper's order."""


@dataclass(frozen=True)
class Book:
    """The results of all cells, by name; methods are named like "pi0/multi/lora_sp"."""

    results: Mapping[str, Any]

    def methods(self, backbone: str, training: str) -> list[str]:
        """Return the methods of a kind of training, in the order of the results."""
        return naming.methods(self.results, backbone, training)

    def ranks(self, backbone: str) -> list[int]:
        """Return LoRA's ranks in ascending order."""
        return naming.lora_ranks(self.results, backbone)

    def table_1_methods(self, backbone: str) -> list[str]:
        """Return the methods of Table I in the paper's order, then those beyond it."""
        highest = f"lora_r{self.ranks(backbone)[-1]}"
        paper = [highest, "lora_moe_top1", "lora_moe_weighted", "ada_lora", "full", "lora_sp"]
        return [*paper, "dora", "lora_same_rank", "lora_cut"]

    def cells(self, prefix: str) -> Seeds:
        """Return the cells of a method by seed."""
        return naming.seeds(self.results, prefix)

    def outcomes(self, prefix: str) -> np.ndarray:
        """Return a method's episodes, bool `[S, T, N]`, tasks in order of name."""
        return naming.outcomes(self.results, self.cells(prefix))

    def rates(self, prefix: str) -> dict[str, float]:
        """Return a method's success by task."""
        tasks = sorted({t for n in self.cells(prefix)[0] for t in self.results[n]["outcomes"]})
        return dict(zip(tasks, self.outcomes(prefix).mean((0, 2)), strict=True))

    def base(self, prefix: str) -> dict[str, float]:
        """Return the base's success by task, from the cell of "pi0/multi" that evaluates it."""
        cells = (c for n, c in self.results.items() if n.startswith(f"{prefix}/"))
        before = next(cell["before"] for cell in cells if "before" in cell)
        return {task: o.count("1") / len(o) for task, o in before.items()}

    def measures(self, prefix: str, name: str) -> list[Any]:
        """Return a measure of every cell of a method; see `measures.measures`."""
        return [self.results[cell]["measures"][name] for cell in naming.flat(self.cells(prefix))]

    def rank_boxes(self, prefix: str) -> dict[str, dict[str, np.ndarray]]:
        """Return the active ranks of a method: tower -> kind of layer -> `[S, L, 5]`.

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
