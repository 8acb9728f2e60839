"""Plans: how many directions each layer gets, for methods of fixed rank (LoRA, DoRA).

A plan is a JSON file, as `lorasp-jax allocate` writes it or a person does:

    {"format": "lorasp_jax plan", "version": 1, "backbone": "pi0",
     "ranks": {"language/blocks/q_proj": [4, 7, 0], "state_proj": [12]}}

`ranks` has a list for every layer that a run adapts, with one entry per layer of a stack. 0 is no
adapter. A `budget`, if there is one, is the most parameters that the plan may have. A plan is not
one of learning rates: the scale of the method is the same in all layers.
"""

import dataclasses
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lorasp_jax.base.files import as_value_error, read_json
from lorasp_jax.base.json_values import check
from lorasp_jax.base.writing import write_text
from lorasp_jax.peft.dora import DoRA
from lorasp_jax.peft.fields import check_names, short
from lorasp_jax.peft.lora import LoRA
from lorasp_jax.peft.method import Method

FORMAT, VERSION = "lorasp_jax plan", 1
_FIELDS = {"backbone": str, "ranks": {str: [int]}, "source?": str, "rule?": str, "budget?": int}

Shapes = Mapping[str, tuple[int, int, int]]
"""(L, I, O) by the path of a layer: L matrices [I, O], one if it is no stack."""


@dataclasses.dataclass(frozen=True)
class RankPlan:
    """Ranks by layer.

    Raises:
        ValueError: there are no ranks, or one is negative.
    """

    backbone: str
    """Name of the backbone that the plan is for, such as "pi0"."""
    ranks: Mapping[str, tuple[int, ...]] = dataclasses.field(hash=False)
    """The rank of each layer of a stack, by path."""
    source: str = ""
    """The run that it was made from, with a digest of its adapters."""
    rule: str = ""
    """How it was made."""
    budget: int = 0
    """How many parameters it may have, as `count` counts them; 0: not limited."""

    def __post_init__(self) -> None:
        if not any(map(any, self.ranks.values())):
            raise ValueError("a plan must have a rank above 0")
        for path, ranks in self.ranks.items():
            if min(ranks, default=0) < 0:
                raise ValueError(f"a plan's ranks must be at least 0, got {min(ranks)} for {path}")

    @classmethod
    def from_json(cls, fields: dict[str, Any]) -> "RankPlan":
        """Return a plan from the fields of its file, except format and version.

        Raises:
            ValueError: a field is missing, unknown or invalid.
        """
        check(fields, _FIELDS)
        check_names(cls, "a plan", (), fields)
        ranks = {path: tuple(each) for path, each in fields["ranks"].items()}
        values: dict[str, Any] = {**fields, "ranks": ranks}
        return cls(**values)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the plan to a file, with one line per layer, and create the file's folder."""
        fields = {x.name: getattr(self, x.name) for x in dataclasses.fields(self)}
        entry = lambda name, value: f"{json.dumps(name)}: {json.dumps(value)}"  # noqa: E731
        layers = ",\n    ".join(entry(*each) for each in fields.pop("ranks").items())
        head = {"format": FORMAT, "version": VERSION, **fields}
        lines = [*(entry(*each) for each in head.items()), f'"ranks": {{\n    {layers}\n  }}']
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_text(Path(path), "{\n  " + ",\n  ".join(lines) + "\n}\n")

    def count(self, shapes: Shapes) -> int:
        """Return the number of parameters of A and B, Σ r (I + O), of a plan for these layers."""
        return sum(sum(ranks) * sum(shapes[path][1:]) for path, ranks in self.ranks.items())

    def check(self, shapes: Shapes) -> None:
        """Raise ValueError unless the plan is one for exactly these layers, within its budget."""
        names = ", ".join([*shapes][:5])
        if unknown := self.ranks.keys() - shapes.keys():
            raise ValueError(
                f"the plan has {short(min(unknown))}, which is none of the {len(shapes)} layers to "
                f"adapt, such as {names}"
            )
        if missing := [path for path in shapes if path not in self.ranks]:
            raise ValueError(
                f"the plan lacks {missing[0]}, one of the {len(shapes)} layers to adapt: its ranks "
                "may be 0, or choose others with --targets"
            )
        for path, (layers, d_in, d_out) in shapes.items():
            if len(ranks := self.ranks[path]) != layers:
                raise ValueError(
                    f"the plan must have {layers} ranks for {path}, one per layer, got {len(ranks)}"
                )
            if max(ranks) > min(d_in, d_out):
                raise ValueError(
                    f"the plan has rank {max(ranks)} for {path}, but its kernels are {d_in} x "
                    f"{d_out}: at most {min(d_in, d_out)}"
                )
        if self.budget and (count := self.count(shapes)) > self.budget:
            raise ValueError(
                f"the plan has {count:,} parameters, more than its budget of {self.budget:,}: "
                "lower its ranks, or leave out the budget"
            )

    def rules(self, method: Method) -> dict[str, tuple[str, Method | None]]:
        """Return rules for `adapt` by path, which give each layer the method with its rank.

        α is set so that the scale is that of `method`.

        Raises:
            ValueError: the method has no fixed rank, or its initialization depends on it; or DoRA,
                whose magnitudes train with any rank, has layers with and without in one stack.
        """
        if not isinstance(method, LoRA):
            raise ValueError(f"a plan is for lora or dora, not for {method.name}: choose --method")
        found: dict[str, tuple[str, Method | None]] = {}
        for path, ranks in self.ranks.items():
            if isinstance(method, DoRA) and any(ranks) and not all(ranks):
                raise ValueError(f"dora needs ranks of at least 1 or only 0 in the stack {path}")
            found[path] = f"^{re.escape(path)}$", _planned(method, ranks) if any(ranks) else None
        return found


def _planned(method: LoRA, ranks: tuple[int, ...]) -> LoRA:
    rank = max(ranks)
    alpha = method.scale * (rank**0.5 if method.rank_stabilized else rank)
    return dataclasses.replace(method, rank=rank, alpha=alpha, ranks=ranks)


def read(path: str | os.PathLike[str]) -> RankPlan:
    """Read a plan's file.

    Raises:
        ValueError: it is missing, invalid, or of another version.
    """
    path = Path(path)
    with as_value_error(path, problem="is invalid"):
        fields = read_json(path)
        check(fields, {"format": str, "version": int})
        if (fields.pop("format"), fields.pop("version")) != (FORMAT, VERSION):
            raise ValueError(f"it must be a {FORMAT} of version {VERSION}")
        return RankPlan.from_json(fields)


def allocate(
    importance: Mapping[str, tuple[float, ...]],
    shapes: Shapes,
    budget: float,
    *,
    most: int,
    least: int = 1,
    drop: int = 0,
) -> dict[str, tuple[int, ...]]:
    """Return ranks in proportion to the importance of layers, within a budget of parameters.

    r = clip(round(c · importance), least, most), also at most min(I, O), with the largest c for
    which Σ r (I + O) is within the budget. What is left of it is less than one direction costs in
    the largest layer, unless all layers of any importance are at their upper bound.

    Args:
        importance: of each layer of a stack, by path; at least 0.
        shapes: of the same layers.
        budget: number of parameters.
        most: largest rank.
        least: smallest rank.
        drop: how many of the least important layers get rank 0 instead; not all.

    Raises:
        ValueError: a layer has no importance, or one that is negative or not finite, the budget is
            too small, or `drop` is negative or drops all layers.
    """
    for path, (layers, _, _) in shapes.items():
        if len(importance.get(path, ())) != layers:
            raise ValueError(f"importance must have {layers} numbers for {path}")
        if wrong := [x for x in importance[path] if not 0 <= x < np.inf]:
            raise ValueError(f"importance must be finite and at least 0, got {wrong[0]} for {path}")
    values = np.concatenate([np.asarray(importance[path], float) for path in shapes])
    if not 0 <= drop < len(values):
        raise ValueError(f"drop must be at least 0 and below {len(values)} layers, got {drop}")
    counts = [layers for layers, _, _ in shapes.values()]
    spread = lambda each: np.repeat(np.array(each), counts)  # noqa: E731
    cost = spread([d_in + d_out for _, d_in, d_out in shapes.values()])
    high = spread([min(most, d_in, d_out) for _, d_in, d_out in shapes.values()])
    low = np.minimum(least, high)
    dropped = np.argsort(values, kind="stable")[:drop]
    low[dropped] = high[dropped] = 0
    if low @ cost > budget:
        raise ValueError(
            f"a budget of {budget:,.0f} parameters is too small for ranks of at least {least}: "
            f"{len(values)} layers, {drop} of them dropped, need {low @ cost:,}"
        )
    ranks = _within(values, low, high, cost, budget)
    ends = np.cumsum(counts)[:-1]
    return {
        path: tuple(each.tolist()) for path, each in zip(shapes, np.split(ranks, ends), strict=True)
    }


def _within(
    values: np.ndarray, low: np.ndarray, high: np.ndarray, cost: np.ndarray, budget: float
) -> np.ndarray:
    """Bisect c, then spend what is left on the layers whose rounding would come next."""
    ranks_of = lambda c: np.clip(np.floor(c * values + 0.5), low, high).astype(int)  # noqa: E731
    small, large = 0.0, (high.max() + 1) / max(values[values > 0].min(initial=np.inf), 1e-9)
    for _ in range(200):
        c = (small + large) / 2
        small, large = (c, large) if ranks_of(c) @ cost <= budget else (small, c)
    ranks = ranks_of(small)
    for i in np.argsort(ranks - small * values, kind="stable"):
        more = ranks[i] < high[i] and ranks @ cost + cost[i] <= budget
        ranks[i] += more
    return ranks


def shuffled(plan: RankPlan, shapes: Shapes, key: jax.Array) -> RankPlan:
    """Return the plan with its ranks permuted among the layers of equal size, as a control.

    Only layers whose kernels are both [I, O] or [O, I] swap ranks, so the number of parameters is
    exactly the plan's. A layer that is the only one of its size keeps its rank.
    """
    places = [(path, i) for path, ranks in plan.ranks.items() for i in range(len(ranks))]
    ranks = {path: list(ranks) for path, ranks in plan.ranks.items()}
    for number, size in enumerate(sorted({tuple(sorted(shapes[path][1:])) for path in plan.ranks})):
        alike = [place for place in places if tuple(sorted(shapes[place[0]][1:])) == size]
        order = jax.random.permutation(jax.random.fold_in(key, number), len(alike))
        for (path, i), j in zip(alike, order.tolist(), strict=True):
            source, k = alike[j]
            ranks[path][i] = plan.ranks[source][k]
    found = {path: tuple(each) for path, each in ranks.items()}
    return dataclasses.replace(plan, ranks=found, rule=f"{plan.rule}, shuffled".lstrip(", "))
