"""Why LoRA-SP does not gain over LoRA here, in sentences made from the results.

A reason that the results do not support is left out.
"""

from collections.abc import Callable

from lorasp_jax.extras.study import statistics
from lorasp_jax.extras.study.statistics import Estimate
from studies.paper import naming, published
from studies.paper.book import Book, on_each
from studies.paper.main_result import lead

Pair = tuple[str, str]
"""Two methods, such as ("multi/full", "single/full")."""


def no_gain(book: Book) -> str:
    """Return a section with all reasons; "" before the runs, or if LoRA-SP gains."""
    highest = f"lora_r{book.rank}"
    done = book.complete("multi/lora_sp", f"multi/{highest}")
    if not done or any(lead(book, backbone, highest).low > 0 for backbone in done):
        return ""
    reasons = _little_left(book), _fewer_directions(book), _highest_rate(book), _together(book)
    listed = "".join(f"- {text}\n" for text in reasons if text)
    return (
        f"### Why LoRA-SP does not gain here\n\n{listed}\nThe rest of the difference from the "
        "paper may come from model size, pretraining, data, learning rates or the router; this "
        "study cannot tell.\n\n"
    )


def _little_left(book: Book) -> str:
    """Say how near LoRA with r = R comes to full fine-tuning."""
    methods = f"multi/lora_r{book.rank}", "multi/full"
    found = _compared(book, methods, lambda lora, full: f"{100 * lora / full:.1f}")
    if not found:
        return ""
    return (
        f"**Little is left to gain.** LoRA with r = {book.rank} reaches, in % of full "
        f"fine-tuning's success, {on_each(found)}."
    )


def _fewer_directions(book: Book) -> str:
    """Compare LoRA-SP without and with the spectral loss; "" if the loss raises success."""
    methods = "multi/lora_sp_no_spectral", "multi/lora_sp"
    found = _compared(book, methods)
    if not found or any(_difference(book, b, methods).high < 0 for b in found):
        return ""
    return (
        "**Fewer directions do not raise success.** Success without the spectral loss against "
        f"success with it, in %: {on_each(found)}."
    )


def _highest_rate(book: Book) -> str:
    """Compare LoRA-SP and LoRA at the highest rate and at each one's best; "" unless they turn."""
    found, rate = {}, 0.0
    methods = "pilot/lora_sp", f"pilot/lora_r{book.rank}"
    for backbone in book.complete(*methods):
        sp, lora = (_by_rate(book, f"{backbone}/{method}") for method in methods)
        rate = max(sp)
        if sp[rate] <= lora[rate] or max(sp.values()) > max(lora.values()):
            return ""
        found[backbone] = f"{100 * (sp[rate] - lora[rate]):.1f} points"
    if not found:
        return ""
    return (
        f"**A learning rate can make such a gap.** At {rate:g}, in one run each, LoRA-SP leads "
        f"LoRA by {on_each(found)}; at each method's best of three rates, it does not lead."
    )


def _by_rate(book: Book, prefix: str) -> dict[float, float]:
    """Return the success of a method's pilot cells by learning rate."""
    cells = naming.flat(book.cells(prefix))
    return {naming.rate(n): naming.outcomes(book.results, ((n,),)).mean() for n in cells}


def _together(book: Book) -> str:
    """Compare one policy for all tasks with one per task."""
    texts, harm = [], False
    for method in ("full", f"lora_r{book.rank}"):
        kinds = f"multi/{method}", f"single/{method}"
        found = _compared(book, kinds)
        texts += [f"{naming.label(method, book.rank)} {on_each(found)}"] if found else []
        harm |= any(_difference(book, b, kinds).high < 0 for b in found)
    if not texts:
        return ""
    title = f"Training tasks together did {'some' if harm else 'no'} harm"
    return f"**{title}.** One policy for all tasks against one per task, in %: {'; '.join(texts)}."


def _against(a: float, b: float) -> str:
    return f"{100 * a:.1f} against {100 * b:.1f}"


def _compared(
    book: Book, methods: Pair, show: Callable[[float, float], str] = _against
) -> dict[str, str]:
    """Return the rates of two methods by finished backbone, the paper's in brackets."""
    found = {}
    for backbone in book.complete(*methods):
        prefixes = [f"{backbone}/{method}" for method in methods]
        means = lambda *rates: show(*(float(r.mean()) for r in rates))  # noqa: E731
        paper = published.compute(means, prefixes, book.rank)
        ours = means(*map(book.outcomes, prefixes))
        found[backbone] = ours if paper is None else f"{ours} ({paper})"
    return found


def _difference(book: Book, backbone: str, methods: Pair) -> Estimate:
    return statistics.difference(*(book.outcomes(f"{backbone}/{m}") for m in methods))
