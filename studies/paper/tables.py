"""Tables of the study of the paper, in Markdown, beside the paper's numbers."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from lorasp_jax.extras.study import statistics
from lorasp_jax.peft import LoRASP
from studies.paper import naming, published
from studies.paper.book import BACKBONES, NONE, TASKS, Book, markdown, percent
from studies.paper.naming import TOWERS

Column = tuple[str, Callable[[str], str]]
"""Title of a column, and its text for a method that is finished."""


def success_table(
    book: Book,
    backbone: str,
    training: str,
    labels: Mapping[str, str],
    columns: Sequence[Column] = (),
    *,
    with_base: bool = False,
) -> str:
    """Return success by method and task, the paper's numbers in brackets, after other columns.

    If no method is finished, return only how many runs there are.

    Args:
        book: the results.
        backbone: shown in the table, like `training`.
        training: "multi" or "single".
        labels: methods and their names in the table.
        columns: further columns.
        with_base: whether to begin with the base before adaptation.
    """
    prefixes = [f"{backbone}/{training}/{method}" for method in labels]
    if all(book.missing(prefix) for prefix in prefixes):
        return f"{book.missing(*prefixes)}.\n"
    headers = ["method", *(t for t, _ in columns), *TASKS.values(), "mean [95 % interval]"]
    rows = [_base(book, backbone, len(columns))] if with_base else []
    for prefix, name in zip(prefixes, labels.values(), strict=True):
        paper = published.cell(prefix, book.rank).get("success", {})
        if missing := book.missing(prefix):
            cells = [NONE for _ in columns] + [_with("", paper.get(task)) for task in TASKS]
            rows.append([name, *cells, _with(missing, _mean(paper))])
            continue
        rates = dict(zip(book.tasks(prefix), book.outcomes(prefix).mean((0, 2)), strict=True))
        cells = [text(prefix) for _, text in columns]
        for task in TASKS:
            ours = f"{100 * rates[task]:.1f}" if task in rates else ""
            cells.append(_with(ours, paper.get(task)))
        rows.append([name, *cells, _with(_success(book, prefix), _mean(paper))])
    return markdown(headers, rows)


def _success(book: Book, prefix: str) -> str:
    """Return a method's mean success and its interval, or how many of its runs there are."""
    return book.missing(prefix) or percent(statistics.success(book.outcomes(prefix)))


def _with(ours: str, paper: float | None, digits: int = 1) -> str:
    """Return our number, and the paper's in brackets."""
    brackets = "" if paper is None else f"({paper:.{digits}f})"
    return f"{ours} {brackets}".strip() or NONE


def _mean(paper: Mapping[str, float]) -> float | None:
    return float(np.mean(list(paper.values()))) if paper else None


def table_1(book: Book, backbone: str) -> str:
    """Return Table I: methods, their size, active rank and multi-task success, after the base's."""
    methods = _labels(book, book.table_1_methods(backbone))
    columns = [("trainable %", _trainable(book)), ("active rank", _rank(book))]
    return success_table(book, backbone, "multi", methods, columns, with_base=True)


def _base(book: Book, backbone: str, columns: int) -> list[str]:
    """Return the row of the base before adaptation, from the cell that evaluates it."""
    rates = book.base(f"{backbone}/multi/")
    tasks = (f"{100 * rates[task]:.1f}" if task in rates else NONE for task in TASKS)
    return ["base, not adapted", *[NONE] * columns, *tasks, _base_success(rates)]


def _base_success(rates: Mapping[str, float]) -> str:
    """Return the base's mean success."""
    return f"{100 * np.mean([*rates.values()]):.1f}" if rates else "0 of 1 runs so far"


def table_2(book: Book) -> str:
    """Return the mean success of Table II's methods by backbone and kind of training."""
    kinds = {
        (backbone, training): title
        for backbone in book.backbones
        for training, title in (("single", "one per task"), ("multi", "all tasks"))
        if book.methods(backbone, "single")
    }
    if not kinds:
        return ""
    methods = dict.fromkeys(m for backbone, _ in kinds for m in _table_2_methods(book, backbone))
    headers = [f"{BACKBONES[backbone]}, {title}" for (backbone, _), title in kinds.items()]
    rows = []
    for method in methods:
        row = [naming.label(method, book.rank)]
        for backbone, training in kinds:
            prefix = f"{backbone}/{training}/{method}"
            paper = published.cell(prefix, book.rank).get("success", {})
            row.append(_with(_success(book, prefix), _mean(paper)))
        rows.append(row)
    return markdown(["method", *headers], rows)


def table_2_by_task(book: Book, backbone: str) -> str:
    """Return Table II: LoRA of all ranks, full fine-tuning and LoRA-SP, both ways of training."""
    parts = []
    for training, title in (("single", "one policy per task"), ("multi", "one for all tasks")):
        if book.methods(backbone, "single"):
            methods = _labels(book, _table_2_methods(book, backbone))
            rows = success_table(book, backbone, training, methods)
            parts.append(f"**{BACKBONES[backbone]}, {title}**\n\n{rows}")
    return "\n".join(parts)


def _table_2_methods(book: Book, backbone: str) -> list[str]:
    return [*(f"lora_r{rank}" for rank in book.ranks(backbone, "multi")), "full", "lora_sp"]


def table_3(book: Book, backbone: str) -> str:
    """Return Table III: LoRA-SP with and without spectral loss, with ranks by tower."""
    methods = ["lora_sp_no_spectral", "lora_sp"]
    if methods[0] not in book.methods(backbone, "multi"):
        return ""
    columns = [(tower, _tower(book, index)) for index, tower in enumerate(TOWERS)]
    return success_table(book, backbone, "multi", _labels(book, methods), columns)


def table_4(book: Book, backbone: str) -> str:
    """Return Table IV: LoRA-SP with other energy targets."""
    etas = [m for m in book.methods(backbone, "multi") if m.startswith("lora_sp_eta")]
    methods = sorted(m for m in etas if not m.endswith("_pruned"))
    if not methods:
        return ""
    methods.insert(-1, "lora_sp")  # .9 comes before .99
    labels = _labels(book, methods) | {"lora_sp": f"LoRA-SP, η = {LoRASP().energy_target:g}"}
    return success_table(book, backbone, "multi", labels, [("active rank", _rank(book))])


def pruning(book: Book, backbone: str) -> str:
    """Return what pruning after training saves and costs."""
    headers = ["method", "adapters [MB]", "success", "after pruning"]
    rows = []
    methods = [m for m in book.methods(backbone, "multi") if m.endswith("_pruned")]
    for method in methods:
        prefix = f"{backbone}/multi/{method}"
        source = prefix.removesuffix("_pruned")
        name = naming.label(method.removesuffix("_pruned"), book.rank)
        if missing := book.missing(prefix, source):
            rows.append([name, NONE, NONE, missing])
            continue
        sizes = np.mean([s["bytes"] for s in book.measures(prefix, "smaller")], axis=0) / 1e6
        rows.append([name, _arrow(sizes), _success(book, source), _success(book, prefix)])
    return markdown(headers, rows) if rows else ""


def robots(book: Book) -> str:
    """Return success before and after full fine-tuning, on the robots of Figure 4."""
    rows = []
    for backbone in (b for b in book.backbones if book.methods(b, "panda")):
        for training, robot in (("panda", "Panda, seen"), ("multi", "PiPER, unseen")):
            prefix = f"{backbone}/{training}/"
            success = _base_success(book.base(prefix)), _success(book, f"{prefix}full")
            rows.append([f"{BACKBONES[backbone]}, {robot}", *success])
    return markdown(["", "base", "after full fine-tuning"], rows) if rows else ""


def costs(book: Book, backbone: str) -> str:
    """Return what each method of Table I costs, without times: runs shared GPUs."""
    headers = ["method", "trainable", "GFLOP per sample", "memory [GiB]"]
    fields = (
        (("trainable_parameters",), 1e-6, " M"),
        (("speed", "flops_per_sample"), 1e-9, ""),
        (("speed", "peak_bytes"), 2**-30, ""),
    )
    rows = []
    for method in book.table_1_methods(backbone):
        if method == "lora_cut":  # it is not trained
            continue
        prefix = f"{backbone}/multi/{method}"
        name = naming.label(method, book.rank)
        if missing := book.missing(prefix):
            rows.append([name, missing, *[NONE] * (len(fields) - 1)])
            continue
        values = [(book.mean(prefix, *path), scale, unit) for path, scale, unit in fields]
        rows.append(
            [
                name,
                *(NONE if v is None else f"{float(f'{v * s:.3g}'):,g}{u}" for v, s, u in values),
            ]
        )
    return markdown(headers, rows)


def rates(book: Book) -> str:
    """Return the success of each method's pilot cells, the chosen learning rate in bold."""
    names = [name.split("/") for name in book.names]
    values = list(dict.fromkeys(name[3] for name in names if name[1] == "pilot"))
    methods = dict.fromkeys(name[2] for name in names if name[1] == "pilot")
    headers = [f"{BACKBONES[b]}, {float(v):g}" for b in book.backbones for v in values]
    rows = []
    for method in methods:
        row = [naming.label(method, book.rank)]
        for backbone in book.backbones:
            row += _rates(book, f"{backbone}/pilot/{method}", len(values))
        rows.append(row)
    return markdown(["method", *headers], rows)


def _rates(book: Book, prefix: str, count: int) -> list[str]:
    """Return the success of one method's pilot cells."""
    if missing := book.missing(prefix):
        return [missing, *[NONE] * (count - 1)]
    names = naming.flat(book.cells(prefix))
    best = naming.best_pilot(book.results, names)
    means = {n: f"{100 * naming.outcomes(book.results, ((n,),)).mean():.1f}" for n in names}
    return [f"**{means[n]}**" if n == best else means[n] for n in names]


def _labels(book: Book, methods: Iterable[str]) -> dict[str, str]:
    return {method: naming.label(method, book.rank) for method in methods}


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
    return " → ".join(f"{value:#.3g}" for value in pair)
