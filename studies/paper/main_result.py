"""How LoRA-SP compares with LoRA, in sentences made from the results."""

from collections.abc import Iterable

from lorasp_jax.extras.study import statistics
from lorasp_jax.extras.study.statistics import Estimate
from studies.paper import published
from studies.paper.book import BACKBONES, Book, on_each, points, signed


def main_result(book: Book) -> str:
    """Compare LoRA-SP with LoRA of three ranks; "" before the runs."""
    highest, half, same = f"lora_r{book.rank}", f"lora_r{book.rank // 2}", "lora_same_rank"
    done = book.complete(*(f"multi/{method}" for method in ("lora_sp", highest, half, same)))
    if not done:
        return ""
    leads = {m: {b: lead(book, b, m) for b in done} for m in (highest, half, same)}
    better = [BACKBONES[b] for b in done if leads[highest][b].low > 0]
    gains = f"gains on {_and(better)}" if better else "shows no gain"
    times = _and(f"{_size(book, b, 'lora_sp') / _size(book, b, same):.1f}" for b in done)
    return (
        f"**Main result: LoRA-SP {gains} over LoRA with r = R.** LoRA-SP's success, averaged over "
        "the tasks, minus that of LoRA, with 95 % intervals:\n\n"
        f"- with r = R = {book.rank}: {_each(leads[highest])}{_paper(book, leads[highest])}\n"
        f"- with r = LoRA-SP's mean active rank: {_each(leads[same])}; LoRA-SP trains {times} "
        "times as many parameters\n"
        f"- with r = R/2 = {book.rank // 2}: {_each(leads[half])}\n\n"
        "The last two comparisons are post hoc: no claim makes them.\n\n"
    )


def lead(book: Book, backbone: str, method: str) -> Estimate:
    """Return LoRA-SP's success minus that of another method, both for all tasks."""
    prefixes = f"{backbone}/multi/lora_sp", f"{backbone}/multi/{method}"
    return statistics.difference(*map(book.outcomes, prefixes))


def _paper(book: Book, leads: dict[str, Estimate]) -> str:
    """Return the paper's leads over LoRA with r = R, and whether they lie in our intervals."""
    found = {}
    for backbone in leads:
        prefixes = f"{backbone}/multi/lora_sp", f"{backbone}/multi/lora_r{book.rank}"
        difference = published.compute(statistics.minus, prefixes, book.rank)
        if difference is not None:
            found[backbone] = float(difference)
    if not found:
        return ""
    outside = all(not leads[b].low <= theirs <= leads[b].high for b, theirs in found.items())
    theirs = _and(signed(100 * difference) for difference in found.values())
    return f"; the paper has {theirs}, {'' if outside else 'not all '}outside these intervals"


def _size(book: Book, backbone: str, method: str) -> float:
    return book.mean(f"{backbone}/multi/{method}", "trainable_parameters") or 1.0


def _each(estimates: dict[str, Estimate]) -> str:
    return on_each({backbone: points(estimate) for backbone, estimate in estimates.items()})


def _and(texts: Iterable[str]) -> str:
    return " and ".join(texts)
