"""What tables and figures of the study's page show, in sentences made from the results."""

from collections.abc import Iterable

import numpy as np

from lorasp_jax.extras.study import statistics
from studies.paper import naming, published
from studies.paper.book import BACKBONES, TASKS, Book, on_each, points

_FEW = 0.1
"""Share of the adapters below which pruning removes little."""
_EASY = 0.975
"""Rate above which a task is easy; it prints as 98 %."""


def experts(book: Book) -> str:
    """Return the sizes of LoRA-MoE; "" before its first run."""
    for name, cell in book.results.items():
        if "/multi/lora_moe" in name:
            peft = cell["config"]["peft"]
            return f"LoRA-MoE has {peft['experts']} experts of rank {peft['rank']}."
    return ""


def edges(book: Book) -> str:
    """Name the methods whose best learning rate is the lowest or the highest; "" if none is."""
    texts = []
    for backbone in book.backbones:
        methods = book.methods(backbone, "pilot")
        done = [m for m in methods if not book.missing(f"{backbone}/pilot/{m}")]
        found = [naming.label(m, book.rank) for m in done if _at_edge(book, backbone, m)]
        if found:
            texts.append(f"On {BACKBONES[backbone]}: {'; '.join(found)}.")
    if not texts:
        return ""
    return (
        "Where the best is the lowest or the highest of the three, a better one may lie beyond. "
        f"{' '.join(texts)}"
    )


def _at_edge(book: Book, backbone: str, method: str) -> bool:
    names = sorted(naming.flat(book.cells(f"{backbone}/pilot/{method}")), key=naming.rate)
    return naming.best_pilot(book.results, names) in (names[0], names[-1])


def pruned(book: Book) -> str:
    """Say what pruning does to LoRA-SP; "" before its runs."""
    done = book.complete("multi/lora_sp", "multi/lora_sp_pruned")
    return " ".join(_pruned(book, backbone) for backbone in done)


def _pruned(book: Book, backbone: str) -> str:
    source = f"{backbone}/multi/lora_sp"
    sizes = np.mean([s["bytes"] for s in book.measures(f"{source}_pruned", "smaller")], axis=0)
    share, rank = 1 - sizes[1] / sizes[0], book.mean(source, "active_rank", "mean")
    change = statistics.difference(book.outcomes(f"{source}_pruned"), book.outcomes(source))
    few = share < _FEW
    why = ", because nearly every direction serves some token" if few else ""
    return (
        f"On {BACKBONES[backbone]}, pruning removes {'only ' if few else ''}{100 * share:.0f} % of "
        f"LoRA-SP's adapters although a token uses {rank:.0f} of {book.rank} directions{why}. "
        f"Success changes by {points(change)}."
        f"{' A low active rank is not a small adapter.' if few else ''}"
    )


def shared_directions(book: Book) -> str:
    """Say which tasks share most and fewest directions; "" before the runs."""
    return _paragraph(_shared_directions(book, b) for b in book.complete("multi/lora_sp"))


def _shared_directions(book: Book, backbone: str) -> str:
    cells = book.measures(f"{backbone}/multi/lora_sp", "direction_overlap")
    index = {pair: np.mean([cell[pair]["all"] for cell in cells], axis=0) for pair in cells[0]}
    high, low = (choose(index, key=lambda p: index[p][0]) for choose in (max, min))
    return (
        f"On {BACKBONES[backbone]}, {_pair(high)} share the most directions (overlap "
        f"{index[high][0]:.2f}, by chance {index[high][1]:.2f}), {_pair(low)} the fewest "
        f"({index[low][0]:.2f}, by chance {index[low][1]:.2f})."
    )


def gradients(book: Book) -> str:
    """Give the mean cosines of LoRA-SP and full fine-tuning; "" before the runs."""
    texts = []
    for method in ("lora_sp", "full"):
        done = book.complete(f"multi/{method}")
        found = {b: _cosines(book, f"{b}/multi/{method}") for b in done}
        texts += [f"{naming.label(method, book.rank)} {on_each(found)}"] if found else []
    if not texts:
        return ""
    return (
        "Mean cosine between two tasks against that between two batches of one: "
        f"{'; '.join(texts)}.\n\n"
    )


def _cosines(book: Book, prefix: str) -> str:
    two, one = (f"{np.mean(c) + 0.0:.2f}".replace("-", "−") for c in book.cosines(prefix))
    return f"{two} against {one}"


def easy_tasks(book: Book) -> str:
    """Name the tasks that all trained methods of Table I solve; "" if these are none or all."""
    found: dict[str, list[float]] = {}
    for backbone in book.backbones:
        methods = (m for m in book.table_1_methods(backbone) if m != "lora_cut")
        for prefix in (f"{backbone}/multi/{method}" for method in methods):
            if not book.missing(prefix):
                means = book.outcomes(prefix).mean((0, 2))
                for task, rate in zip(book.tasks(prefix), means, strict=True):
                    found.setdefault(task, []).append(float(rate))
    easy = [TASKS[task] for task in TASKS if min(found.get(task, [0])) > _EASY]
    if not 0 < len(easy) < len(found):
        return ""
    names = " and ".join(f"“{name}”" for name in easy)
    halved = ", so the mean over tasks about halves them" if 2 * len(easy) == len(found) else ""
    lowest = min(min(found[task]) for task in TASKS if TASKS[task] in easy)
    return (
        f"- In {names}, every trained method of Table I has {100 * lowest:.0f} to 100 % success. "
        f"Differences come mostly from the others{halved}.\n"
    )


def harder_scene(book: Book) -> str:
    """Say that the seen robot has the harder scene; "" if it has not on every backbone."""
    found = {}
    for backbone in book.complete("panda/full", "multi/full"):
        kinds = "panda", "multi"
        seen, unseen = (book.outcomes(f"{backbone}/{kind}/full").mean() for kind in kinds)
        if seen >= unseen:
            return ""
        found[backbone] = f"{100 * seen:.1f} % against {100 * unseen:.1f} %"
    if not found:
        return ""
    return (
        f"The Panda's new scene is harder than PiPER's: after training, {on_each(found)}. A "
        "failure of claim 5 in one scene and with one pretraining does not refute it in general."
        "\n\n"
    )


def adapter_sizes(book: Book) -> str:
    """Compare the size of LoRA's adapters with that of the base; "" before the runs."""
    found = {}
    for backbone in book.complete(f"multi/lora_r{book.rank}"):
        prefix = f"{backbone}/multi/lora_r{book.rank}"
        own, total = (book.mean(prefix, f"{k}_parameters") or 0.0 for k in ("trainable", "total"))
        paper = published.cell(prefix, book.rank).get("trainable")
        theirs = f" ({100 * paper / (100 - paper):.0f} in the paper)" if paper else ""
        found[backbone] = f"{100 * own / (total - own):.0f}{theirs}"
    if not found:
        return ""
    return (
        "At this size, adapters are not small: in % of the base's parameters, LoRA with r = R has "
        f"{on_each(found)}."
    )


def _pair(pair: str) -> str:
    return "“" + "” and “".join(TASKS[task] for task in pair.split("|")) + "”"


def _paragraph(sentences: Iterable[str]) -> str:
    text = " ".join(sentences)
    return text and f"{text}\n\n"
