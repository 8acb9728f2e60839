"""A study: named cells, most of which are training runs."""

import dataclasses
import fnmatch
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, TypeAlias

from lorasp_jax.config import MAX_NAME_BYTES, Config

if TYPE_CHECKING:  # a finished study should load no model code
    import lorasp_jax
    from lorasp_jax.training.demonstrations import Demonstrations
    from lorasp_jax.training.run import Run

Results: TypeAlias = Mapping[str, Mapping[str, Any]]
"""The content of cell.json by cell name."""
Evaluate: TypeAlias = Callable[["Run"], dict[str, Any]]
"""Evaluates the policy of a cell's run; returns what cell.json records: `outcomes`, and more."""
Measure: TypeAlias = Callable[
    ["Run", "Demonstrations", "lorasp_jax.policies.Policy | None"], dict[str, Any]
]
"""Maps a cell's run, held-out demonstrations by task, and the source's policy if the cell is
derived, to further entries of cell.json."""
Transform: TypeAlias = Callable[
    ["lorasp_jax.policies.Policy", Results, "Demonstrations"], "lorasp_jax.policies.Policy"
]
"""Maps the source's policy, the results and held-out demonstrations to a derived cell's policy."""
RESERVED = ("demonstrations", "held_out", "locks", "logs", "repeats", "results.json")
"""What a study's folder contains besides the folders of cells."""
_PART = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._+=-]*")


@dataclass(frozen=True)
class Cell:
    """One training run of a study.

    Attributes:
        name: path of the run's folder in the study's folder, such as "pi0/multi/lora_sp/s0".
        config: the run's config, or a function that makes it from the results of the cells in
            `after`. The config's own name is ignored.
        after: names of the cells that must be finished first.
        group: cells of one group share compiled programs, so a process that has run one prefers the
            others; by default, each cell is its own group.
        measured: whether to call the study's `measure`.
        evaluate: evaluates the trained policy; by default, in simulation.
        source: name of a cell whose folder the run needs, such as one whose base it starts from.
        pool: demonstrations per task of which each seed takes its own `data.episodes` at random; 0:
            all seeds train on the same ones.
    """

    name: str
    config: Config | Callable[[Results], Config]
    after: tuple[str, ...] = ()
    group: str = ""
    measured: bool = True
    evaluate: Evaluate | None = None
    source: str = ""
    pool: int = 0

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of all cells that must be finished first."""
        return (self.source, *self.after) if self.source else self.after


@dataclass(frozen=True)
class Derived:
    """A policy made from that of another cell without training, then evaluated.

    It belongs to the group of `source`.

    Attributes:
        name: path of the folder in the study's folder.
        source: name of the cell whose policy is transformed, or the folder of a finished run.
        transform: makes the policy to evaluate from the source's policy, the results of `source`
            and of the cells in `after`, and held-out demonstrations by task; None: the source's.
        after: names of further cells that must be finished first.
        config: changes the source's config, such as the number of episodes.
        settings: what else the results depend on, recorded with the config.
        evaluate: evaluates the policy; by default, as the source was in simulation.
        measured: whether to call the study's `measure`.
    """

    name: str
    source: str | Path
    transform: Transform | None = None
    after: tuple[str, ...] = ()
    config: Callable[[Config], Config] = lambda config: config
    settings: Mapping[str, Any] = field(default_factory=dict)
    evaluate: Evaluate | None = None
    measured: bool = True

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of all cells that must be finished first."""
        return self.after if isinstance(self.source, Path) else (self.source, *self.after)

    @property
    def group(self) -> str:
        """Cells that are made from one run are a group."""
        return str(self.source)


@dataclass(frozen=True)
class Study:
    """A list of cells.

    Attributes:
        name: the study's folder in the folder of all runs.
        cells: every cell; each comes after those that it needs.
        finished: results that the study starts from; these cells run only if a derived cell needs
            their policies.
        measure: measures the policies of cells further.
        page: returns the generated parts of the README.md in a folder from the results of all cells
            (see `page.fill`), and writes its figures.
        partial: whether `page` takes results that lack cells, too.
    """

    name: str
    cells: tuple[Cell | Derived, ...]
    finished: Results = field(default_factory=dict)
    measure: Measure | None = None
    page: Callable[["Study", Results, Path], dict[str, str]] | None = None
    partial: bool = False

    def __post_init__(self) -> None:
        """Validate names and order.

        Raises:
            ValueError: a name is unsafe, used twice or nested in another, or a cell needs one that
                does not come before it.
        """
        _check_path(self.name)
        if "/" in self.name:
            raise ValueError(f"the name of a study must not contain '/', got {self.name!r}")
        names = {cell.name: cell for cell in self.cells}
        if len(names) < len(self.cells):
            twice = next(cell.name for cell in self.cells if names[cell.name] is not cell)
            raise ValueError(f"two cells have the name {twice!r}")
        for name in names:
            _check_path(name)
            if parents := [str(path) for path in PurePosixPath(name).parents if str(path) in names]:
                raise ValueError(f"cell {name!r} lies in the folder of cell {parents[0]!r}")
        _check_order(self.cells)

    def __getitem__(self, name: str) -> Cell | Derived:
        """Return a cell by name."""
        return next(cell for cell in self.cells if cell.name == name)

    @property
    def groups(self) -> dict[str, tuple[Cell | Derived, ...]]:
        """The cells of each group, in order; groups in the order of their first cells."""
        group_of: dict[str, str] = {}
        groups: dict[str, tuple[Cell | Derived, ...]] = {}
        for cell in self.cells:
            own = group_of.get(cell.group, cell.group) if isinstance(cell, Derived) else cell.group
            group_of[cell.name] = own = own or cell.name
            groups[own] = (*groups.get(own, ()), cell)
        return groups


def evaluated(config: Config, *, tasks: tuple[str, ...] = (), **changes: int) -> Config:
    """Return a config that evaluates some tasks with other settings; 0 or () keeps its own."""
    settings = {name: value for name, value in changes.items() if value}
    evaluation = dataclasses.replace(config.evaluation, **settings)
    return dataclasses.replace(config, tasks=tasks or config.tasks, evaluation=evaluation)


def select(study: Study, only: Sequence[str], shard: tuple[int, int]) -> list[str]:
    """Return the names of a shard's cells that match one of some shell patterns.

    Groups are dealt out in turn, so that every cell is in one shard.

    Raises:
        ValueError: no cell of the study matches one of the patterns.
    """
    matching = set[str]()
    for pattern in only:
        found = {cell.name for cell in study.cells if fnmatch.fnmatchcase(cell.name, pattern)}
        if not found:
            first = study.cells[0].name if study.cells else "none"
            raise ValueError(
                f"no cell of {study.name} matches {pattern!r}; the first cell is {first}"
            )
        matching |= found
    index, count = shard
    groups = list(study.groups.values())[index - 1 :: count]
    return [cell.name for group in groups for cell in group if cell.name in matching]


def _check_path(name: str) -> None:
    """Raise ValueError unless `name` is a relative path of plain folder names."""
    parts = name.split("/")
    if not all(_PART.fullmatch(part) and len(part) <= MAX_NAME_BYTES for part in parts):
        raise ValueError(
            "names must be relative paths of letters, digits and . _ + = -, whose parts do not "
            f"begin with . + = or -, got {name!r}"
        )
    if parts[0] in RESERVED:
        raise ValueError(f"names must not begin with {', '.join(RESERVED)}, got {name!r}")


def _check_order(cells: tuple[Cell | Derived, ...]) -> None:
    """Raise ValueError unless each cell comes after those that it needs: so there is no circle."""
    names, seen = {cell.name for cell in cells}, set[str]()
    for cell in cells:
        for need in cell.needs:
            if need not in seen:
                problem = "which comes later" if need in names else "which does not exist"
                raise ValueError(f"cell {cell.name!r} needs {need!r}, {problem}")
        seen.add(cell.name)
