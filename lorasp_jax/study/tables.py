"""Tables of the study of the paper, in Markdown, beside the paper's numbers."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lorasp_jax.study import naming, published, statistics
from lorasp_jax.study.naming import TOWERS, Seeds
from lorasp_jax.study.statistics import Estimate

BACKBONES = {"pi0": "π0", "smolvla": "SmolVLA"}
TASKS = {
    "open_pot": "open the pot",
    "pour": "pour",
    "press": "press",
    "pick_place": "pick and place",
}
"""Tasks and their titles, in the paper's order."""
NONE = "–"


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

    def methods(self, backbone: str, training: str) -> list[str]:
        """Return the methods of a kind of training, in order."""
        parts = [name.split("/") for name in self.names]
        return list(dict.fromkeys(p[2] for p in parts if p[:2] == [backbone, training]))

    def ranks(self, backbone: str, training: str) -> list[int]:
        """Return LoRA's ranks in ascending order."""
        stems = self.methods(backbone, training)
        return sorted(int(m.removeprefix("lora_r")) for m in stems if m.startswith("lora_r"))

    def cells(self, prefix: str) -> Seeds:
        """Return the cells of a method, such as "pi0/multi/lora_sp", by seed."""
        return naming.seeds(self.names, prefix)

    def missing(self, *prefixes: str) -> str:
        """Return "" if all cells of some methods are finished, else how many are missing."""
        methods = [naming.flat(self.cells(prefix)) for prefix in prefixes]
        count = sum(name not in self.results for names in methods for name in names)
        if count:
            return f"not yet run ({count} of {sum(map(len, methods))})"
        return "" if all(methods) else "the study has no cells for it yet"

    def outcomes(self, prefix: str) -> np.ndarray:
        """Return a method's episodes, bool `[S, T, N]`, tasks in order of name."""
        return naming.outcomes(self.results, self.cells(prefix))

    def tasks(self, prefix: str) -> list[str]:
        """Return a finished method's tasks in order of name."""
        return sorted({t for n in self.cells(prefix)[0] for t in self.results[n]["outcomes"]})

    def mean(self, prefix: str, *path: str) -> float | None:
        """Return a number of the results, averaged over a method's cells; None if it is absent."""
        try:
            return float(np.mean(naming.per_seed(self.results, self.cells(prefix), *path)))
        except KeyError:
            return None


def markdown(headers: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [headers, ["---"] * len(headers), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def percent(estimate: Estimate) -> str:
    """Return a rate with its interval, such as "91.2 [89.0, 93.1]"."""
    value, low, high = (f"{100 * x:.1f}" for x in estimate)
    return f"{value} [{low}, {high}]"


Column = tuple[str, Callable[[str], str]]
"""Title of a column, and its text for a method that is finished."""


def success_table(
    book: Book, backbone: str, training: str, methods: Sequence[str], columns: Sequence[Column] = ()
) -> str:
    """Return success by method and task, the paper's numbers in brackets, after other columns."""
    titles = [TASKS[task] for task in TASKS]
    headers = ["method", *(title for title, _ in columns), *titles, "mean [95 % interval]"]
    rows = []
    for method in methods:
        prefix = f"{backbone}/{training}/{method}"
        paper = published.cell(prefix, book.rank).get("success", {})
        name = naming.label(method, book.rank)
        if missing := book.missing(prefix):
            cells = [NONE for _ in columns] + [_with("", paper.get(task)) for task in TASKS]
            rows.append([name, *cells, _with(missing, _mean(paper))])
            continue
        rates = dict(zip(book.tasks(prefix), book.outcomes(prefix).mean((0, 2)), strict=True))
        cells = [text(prefix) for _, text in columns]
        for task in TASKS:
            ours = f"{100 * rates[task]:.1f}" if task in rates else ""
            cells.append(_with(ours, paper.get(task)))
        mean = percent(statistics.success(book.outcomes(prefix)))
        rows.append([name, *cells, _with(mean, _mean(paper))])
    return markdown(headers, rows)


def _with(ours: str, paper: float | None, digits: int = 1) -> str:
    """Return our number, and the paper's in brackets."""
    brackets = "" if paper is None else f"({paper:.{digits}f})"
    return f"{ours} {brackets}".strip() or NONE


def _mean(paper: Mapping[str, float]) -> float | None:
    return float(np.mean(list(paper.values()))) if paper else None


def table_1(book: Book, backbone: str) -> str:
    """Return Table I: methods, their size, active rank and multi-task success, after the base's."""
    methods = _table_1_methods(book, backbone)
    columns = [("trainable %", _trainable(book)), ("active rank", _rank(book))]
    table = success_table(book, backbone, "multi", methods, columns)
    headers, rule, *rows = table.splitlines(keepends=True)
    base = f"| {' | '.join(_base(book, backbone, len(columns)))} |\n"
    return "".join([headers, rule, base, *rows])


def _base(book: Book, backbone: str, columns: int) -> list[str]:
    """Return the row of the base before adaptation, from the cell that evaluates it."""
    prefix = f"{backbone}/multi/"
    cells = [book.results[n] for n in book.names if n.startswith(prefix) and n in book.results]
    before = next((cell["before"] for cell in cells if "before" in cell), None)
    start = ["base, not adapted", *[NONE] * columns]
    if before is None:
        return [*start, *[NONE] * len(TASKS), "not yet run (1 of 1)"]
    rates = {task: 100 * o.count("1") / len(o) for task, o in before.items()}
    mean = float(np.mean(list(rates.values())))
    return [*start, *(f"{rates[t]:.1f}" if t in rates else NONE for t in TASKS), f"{mean:.1f}"]


def _table_1_methods(book: Book, backbone: str) -> list[str]:
    """Return the methods of Table I in the paper's order, then those beyond it."""
    first = f"lora_r{book.rank}"
    paper = [first, "lora_moe_top1", "lora_moe_weighted", "ada_lora", "full", "lora_sp"]
    own = book.methods(backbone, "multi")
    return [m for m in (*paper, "dora", "lora_same_rank", "lora_cut") if m in own]


def table_2(book: Book, backbone: str) -> str:
    """Return Table II: LoRA of all ranks, full fine-tuning and LoRA-SP, both ways of training."""
    parts = []
    for training, title in (
        ("single", "One policy per task"),
        ("multi", "One policy for all tasks"),
    ):
        if book.methods(backbone, "single"):
            lora = [f"lora_r{rank}" for rank in book.ranks(backbone, training)]
            rows = success_table(book, backbone, training, [*lora, "full", "lora_sp"])
            parts.append(f"{title}:\n\n{rows}")
    return "\n".join(parts)


def table_3(book: Book, backbone: str) -> str:
    """Return Table III: LoRA-SP with and without spectral loss, with ranks by tower."""
    methods = ["lora_sp_no_spectral", "lora_sp"]
    if methods[0] not in book.methods(backbone, "multi"):
        return ""
    columns = [(tower, _tower(book, index)) for index, tower in enumerate(TOWERS)]
    return success_table(book, backbone, "multi", methods, columns)


def table_4(book: Book, backbone: str) -> str:
    """Return Table IV: LoRA-SP with other energy targets."""
    etas = [m for m in book.methods(backbone, "multi") if m.startswith("lora_sp_eta")]
    methods = sorted(m for m in etas if not m.endswith("_pruned"))
    if not methods:
        return ""
    methods.insert(-1, "lora_sp")  # .9 comes before .99
    return success_table(book, backbone, "multi", methods, [("active rank", _rank(book))])


def pruning(book: Book, backbone: str) -> str:
    """Return what pruning after training saves and costs."""
    headers = ["method", "adapters [MB]", "one call [ms]", "success", "after pruning"]
    rows = []
    for method in book.methods(backbone, "multi"):
        if not method.endswith("_pruned"):
            continue
        prefix = f"{backbone}/multi/{method}"
        source = prefix.removesuffix("_pruned")
        name = naming.label(method.removesuffix("_pruned"), book.rank)
        if missing := book.missing(prefix, source):
            rows.append([name, NONE, NONE, NONE, missing])
            continue
        smaller = [book.results[name]["measures"]["smaller"] for (name,) in book.cells(prefix)]
        sizes = np.mean([s["bytes"] for s in smaller], axis=0) / 1e6
        times = np.mean([s["milliseconds"] for s in smaller], axis=0)
        success = [percent(statistics.success(book.outcomes(p))) for p in (source, prefix)]
        rows.append([name, _arrow(sizes), _arrow(times), *success])
    return markdown(headers, rows) if rows else ""


def costs(book: Book, backbone: str) -> str:
    """Return what each method of Table I costs."""
    headers = [
        *("method", "trainable", "GFLOP per sample", "memory [GiB]", "samples/s"),
        "seconds per cell",
    ]
    fields = (
        (("trainable_parameters",), 1e-6, " M"),
        (("speed", "flops_per_sample"), 1e-9, ""),
        (("speed", "peak_bytes"), 2**-30, ""),
        (("speed", "samples_per_second"), 1.0, ""),
        (("seconds", "total"), 1.0, ""),
    )
    rows = []
    for method in _table_1_methods(book, backbone):
        prefix = f"{backbone}/multi/{method}"
        name = naming.label(method, book.rank)
        if missing := book.missing(prefix):
            rows.append([name, missing, *[NONE] * (len(fields) - 1)])
            continue
        values = [(book.mean(prefix, *path), scale, unit) for path, scale, unit in fields]
        rows.append(
            [name, *(NONE if v is None else f"{float(f'{v * s:.3g}'):,g}{u}" for v, s, u in values)]
        )
    return markdown(headers, rows)


def rates(book: Book, backbone: str) -> str:
    """Return the success of each method's pilot cells, the chosen learning rate in bold."""
    methods = book.methods(backbone, "pilot")
    pilots = {m: naming.flat(book.cells(f"{backbone}/pilot/{m}")) for m in methods}
    values = list(
        dict.fromkeys(name.rsplit("/", 1)[1] for names in pilots.values() for name in names)
    )
    rows = []
    for method, names in pilots.items():
        label = naming.label(method, book.rank)
        if missing := book.missing(f"{backbone}/pilot/{method}"):
            rows.append([label, missing, *[NONE] * (len(values) - 1)])
            continue
        best = naming.best_pilot(book.results, names)
        means = {n: f"{100 * naming.outcomes(book.results, ((n,),)).mean():.1f}" for n in names}
        rows.append([label, *(f"**{means[n]}**" if n == best else means[n] for n in names)])
    return markdown(["method", *(f"rate {value}" for value in values)], rows)


def _trainable(book: Book) -> Callable[[str], str]:
    def text(prefix: str) -> str:
        parts = [book.mean(prefix, f"{k}_parameters") for k in ("trainable", "total")]
        ours = "" if None in parts else f"{100 * parts[0] / parts[1]:.1f}"  # pyright: ignore
        return _with(ours, published.cell(prefix, book.rank).get("trainable"))

    return text


def _rank(book: Book) -> Callable[[str], str]:
    def text(prefix: str) -> str:
        mean = book.mean(prefix, "active_rank", "mean")
        paper = published.cell(prefix, book.rank).get("active_rank")
        return _with("" if mean is None else f"{mean:.1f}", paper, 0)

    return text


def _tower(book: Book, index: int) -> Callable[[str], str]:
    def text(prefix: str) -> str:
        mean = book.mean(prefix, "active_rank", TOWERS[index])
        paper = published.cell(prefix, book.rank).get("towers")
        return _with("" if mean is None else f"{mean:.1f}", paper and paper[index], 0)

    return text


def _arrow(pair: Sequence[float]) -> str:
    return " → ".join(f"{value:.3g}" for value in pair)
