"""What tables and figures of the study's page show, in sentences made from the results."""

from collections.abc import Iterable

import numpy as np

from lorasp_jax.study import naming, statistics
from lorasp_jax.study.book import BACKBONES, TASKS, Book


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
    both = book.outcomes(f"{source}_pruned"), book.outcomes(source)
    change, low, high = (100 * x + 0.0 for x in statistics.difference(*both))
    points = f"{change:+.1f} points [{low:+.1f}, {high:+.1f}]".replace("-", "−")
    return (
        f"On {BACKBONES[backbone]}, it shrinks LoRA-SP's adapters by "
        f"{100 * (1 - sizes[1] / sizes[0]):.0f} % and changes success by {points}."
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
    """Say how far tasks pull LoRA-SP in the same direction; "" before the runs."""
    return _paragraph(_gradients(book, b) for b in book.complete("multi/lora_sp"))


def _gradients(book: Book, backbone: str) -> str:
    cosines = map(np.mean, book.cosines(f"{backbone}/multi/lora_sp"))
    two, one = (f"{cosine:.2f}".replace("-", "−") for cosine in cosines)
    return (
        f"For LoRA-SP on {BACKBONES[backbone]}, the cosine is {two} between tasks and {one} "
        "between two batches of one task."
    )


def _pair(pair: str) -> str:
    return "“" + "” and “".join(TASKS[task] for task in pair.split("|")) + "”"


def _paragraph(sentences: Iterable[str]) -> str:
    text = " ".join(sentences)
    return text and f"{text}\n\n"
