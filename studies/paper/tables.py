"""Tables of the study of the paper, in Markdown, beside the paper's numbers."""

import functools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from lorasp_jax.extras.study import page, statistics
from lorasp_jax.extras.study.page import BACKBONES, NONE
from lorasp_jax.extras.study.results import best_pilot, rate_of
from lorasp_jax.peft import LoRASP
from studies.paper import naming, published
from studies.paper.book import TASKS, Book
from studies.paper.naming import TOWERS

Column = tuple[str, Callable[[Book, str], str]]
"""Title of a column, and its text for a method of the results."""
RANK = 64
"""R, LoRA's highest rank and the size of LoRA-SP's bank."""


def blocks(book: Book) -> dict[str, str]:
    """Return all tables by the names of their places in the page."""
    by_backbone = {
        "table I": table_1,
        "table II by task": table_2_by_task,
        "table III": table_3,
        "table IV": table_4,
        "pruning": pruning,
        "costs": costs,
    }
    whole = {"main result": main_result, "rates": rates, "table II": table_2, "robots": robots}
    return {name: make(book) for name, make in whole.items()} | {
        name: "\n".join(filter(None, (make(book, backbone) for backbone in BACKBONES)))
        for name, make in by_backbone.items()
    }


def main_result(book: Book) -> str:
    """Return LoRA-SP's success minus that of LoRA of three ranks."""
    rows = []
    titles = {
        f"lora_r{RANK}": f"r = R = {RANK}",
        "lora_same_rank": "r = LoRA-SP's mean active rank",
        f"lora_r{RANK // 2}": f"r = R/2 = {RANK // 2}",
    }
    for method, title in titles.items():
        row = [title]
        for backbone in BACKBONES:
            pair = [f"{backbone}/multi/{m}" for m in ("lora_sp", method)]
            theirs = published.compute(statistics.minus, pair, RANK)
            paper = NONE if theirs is None else page.signed(100 * float(theirs))
            row += [page.difference(*map(book.outcomes, pair)), paper]
        rows.append(row)
    titles = [t for name in BACKBONES.values() for t in (name, f"{name} in the paper")]
    return page.table(["LoRA-SP minus LoRA with", *titles], rows)


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

    Args:
        book: the results.
        backbone: shown in the table, like `training`.
        training: "multi" or "single".
        labels: methods and their names in the table.
        columns: further columns.
        with_base: whether to begin with the base before adaptation.
    """
    rows = [_base(book, backbone, len(columns))] if with_base else []
    for method, name in labels.items():
        prefix = f"{backbone}/{training}/{method}"
        paper = published.cell(prefix, RANK).get("success", {})
        ours = book.rates(prefix)
        cells = [_with(f"{100 * ours[task]:.1f}", paper.get(task)) for task in TASKS]
        cells.append(_with(_success(book, prefix), _mean(paper)))
        rows.append([name, *(text(book, prefix) for _, text in columns), *cells])
    headers = ["method", *(t for t, _ in columns), *TASKS.values(), "mean [95 % interval]"]
    return page.table(headers, rows)


def _titled(title: str, table: str) -> str:
    return f"**{title}**\n\n{table}"


def _success(book: Book, prefix: str) -> str:
    """Return a method's mean success and its interval."""
    return page.success(book.outcomes(prefix))


def _with(ours: str, paper: float | None, digits: int = 1) -> str:
    """Return our number, and the paper's in brackets."""
    brackets = "" if paper is None else f"({paper:.{digits}f})"
    return f"{ours} {brackets}".strip() or NONE


def _mean(paper: Mapping[str, float]) -> float | None:
    return float(np.mean(list(paper.values()))) if paper else None


def table_1(book: Book, backbone: str) -> str:
    """Return Table I: methods, their size, active rank and multi-task success, after the base's."""
    columns = [("trainable %", _trainable), ("active rank", _rank)]
    labels = _labels(book.table_1_methods(backbone))
    table = success_table(book, backbone, "multi", labels, columns, with_base=True)
    return _titled(BACKBONES[backbone], table)


def _base(book: Book, backbone: str, columns: int) -> list[str]:
    """Return the row of the base before adaptation."""
    rates = book.base(f"{backbone}/multi")
    tasks = (f"{100 * rates[task]:.1f}" for task in TASKS)
    return ["base, not adapted", *[NONE] * columns, *tasks, _base_success(rates)]


def _base_success(rates: Mapping[str, float]) -> str:
    return f"{100 * np.mean([*rates.values()]):.1f}"


def table_2(book: Book) -> str:
    """Return the mean success of Table II's methods by backbone and kind of training."""
    kinds = [(b, t) for b in BACKBONES for t in ("single", "multi")]
    rows = []
    for method, label in _table_2_methods(book).items():
        row = [label]
        for backbone, training in kinds:
            prefix = f"{backbone}/{training}/{method}"
            paper = published.cell(prefix, RANK).get("success", {})
            row.append(_with(_success(book, prefix), _mean(paper)))
        rows.append(row)
    titles = {"single": "one per task", "multi": "all tasks"}
    return page.table(["method", *(f"{BACKBONES[b]}, {titles[t]}" for b, t in kinds)], rows)


def table_2_by_task(book: Book, backbone: str) -> str:
    """Return Table II: LoRA of all ranks, full fine-tuning and LoRA-SP, both ways of training."""
    titles = {"single": "one policy per task", "multi": "one for all tasks"}
    return "\n".join(
        _titled(
            f"{BACKBONES[backbone]}, {title}",
            success_table(book, backbone, training, _table_2_methods(book)),
        )
        for training, title in titles.items()
    )


def _table_2_methods(book: Book) -> dict[str, str]:
    return _labels([*(f"lora_r{rank}" for rank in book.ranks("pi0")), "full", "lora_sp"])


def table_3(book: Book, backbone: str) -> str:
    """Return Table III: LoRA-SP with and without spectral loss, with ranks by tower."""
    methods = ["lora_sp_no_spectral", "lora_sp"]
    if methods[0] not in book.methods(backbone, "multi"):
        return ""
    columns = [(tower, functools.partial(_tower, tower)) for tower in TOWERS]
    table = success_table(book, backbone, "multi", _labels(methods), columns)
    return _titled(BACKBONES[backbone], table)


def table_4(book: Book, backbone: str) -> str:
    """Return Table IV: LoRA-SP with other energy targets."""
    etas = [m for m in book.methods(backbone, "multi") if m.startswith("lora_sp_eta")]
    methods = sorted(m for m in etas if not m.endswith("_pruned"))
    if not methods:
        return ""
    methods.insert(-1, "lora_sp")  # .9 comes before .99
    labels = _labels(methods) | {"lora_sp": f"LoRA-SP, η = {LoRASP().energy_target:g}"}
    table = success_table(book, backbone, "multi", labels, [("active rank", _rank)])
    return _titled(BACKBONES[backbone], table)


def pruning(book: Book, backbone: str) -> str:
    """Return what pruning after training saves and costs."""
    rows = []
    methods = [m for m in book.methods(backbone, "multi") if m.endswith("_pruned")]
    for method in methods:
        prefix = f"{backbone}/multi/{method}"
        source = prefix.removesuffix("_pruned")
        sizes = np.mean([s["bytes"] for s in book.measures(prefix, "smaller")], axis=0) / 1e6
        arrow = " → ".join(f"{size:#.3g}" for size in sizes)
        name = naming.label(method.removesuffix("_pruned"), RANK)
        rows.append([name, arrow, _success(book, source), _success(book, prefix)])
    headers = ["method", "adapters [MB]", "success", "after pruning"]
    return _titled(BACKBONES[backbone], page.table(headers, rows)) if rows else ""


def robots(book: Book) -> str:
    """Return success before and after full fine-tuning, on the robots of Figure 4."""
    rows = []
    for backbone in BACKBONES:
        for training, robot in (("panda", "Panda, seen"), ("multi", "PiPER, unseen")):
            prefix = f"{backbone}/{training}"
            success = _base_success(book.base(prefix)), _success(book, f"{prefix}/full")
            rows.append([f"{BACKBONES[backbone]}, {robot}", *success])
    return page.table(["", "base", "after full fine-tuning"], rows)


def costs(book: Book, backbone: str) -> str:
    """Return what each method of Table I costs, without times: runs shared GPUs."""
    fields = (
        (("trainable_parameters",), 1e-6, " M"),
        (("speed", "flops_per_sample"), 1e-9, ""),
        (("speed", "peak_bytes"), 2**-30, ""),
    )
    rows = []
    for method in book.table_1_methods(backbone)[:-1]:  # lora_cut is not trained
        row = [naming.label(method, RANK)]
        for path, scale, unit in fields:
            value = book.mean(f"{backbone}/multi/{method}", *path) or 0.0
            row.append(f"{float(f'{value * scale:.3g}'):,g}{unit}")
        rows.append(row)
    headers = ["method", "trainable", "GFLOP per sample", "memory [GiB]"]
    return _titled(BACKBONES[backbone], page.table(headers, rows))


def rates(book: Book) -> str:
    """Return the success of each method's pilot cells, the chosen learning rate in bold."""
    methods = book.methods("pi0", "pilot")
    pilots = [n for (n,) in book.cells(f"pi0/pilot/{methods[0]}")]
    headers = [f"{n}, {rate_of(pilot):g}" for n in BACKBONES.values() for pilot in pilots]
    rows = []
    for method in methods:
        row = [naming.label(method, RANK)]
        for backbone in BACKBONES:
            names = naming.flat(book.cells(f"{backbone}/pilot/{method}"))
            best = best_pilot(book.results, names)
            for name in names:
                text = f"{100 * naming.outcomes(book.results, ((name,),)).mean():.1f}"
                row.append(f"**{text}**" if name == best else text)
        rows.append(row)
    return page.table(["method", *headers], rows)


def _labels(methods: Sequence[str]) -> dict[str, str]:
    return {method: naming.label(method, RANK) for method in methods}


def _trainable(book: Book, prefix: str) -> str:
    own, total = (book.mean(prefix, f"{k}_parameters") or 1 for k in ("trainable", "total"))
    return _with(f"{100 * own / total:.1f}", published.cell(prefix, RANK).get("trainable"))


def _rank(book: Book, prefix: str) -> str:
    mean = book.mean(prefix, "active_rank", "mean")
    paper = published.cell(prefix, RANK).get("active_rank")
    return _with("" if mean is None else f"{mean:.1f}", paper, 0)


def _tower(tower: str, book: Book, prefix: str) -> str:
    paper = published.cell(prefix, RANK).get("towers")
    ours = f"{book.mean(prefix, 'active_rank', tower):.1f}"
    return _with(ours, paper and paper[TOWERS.index(tower)], 0)
