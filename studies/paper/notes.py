"""Sentences below the numbers behind the verdicts: what these numbers depend on."""

from collections.abc import Mapping

import numpy as np

from lorasp_jax.extras.study import statistics
from studies.paper import naming, published
from studies.paper.book import BACKBONES, Book, on_each, percent, signed
from studies.paper.naming import TOWERS

_STATE = "state_proj"
"""The linear layer that reads the robot's state."""


def highest_rank(book: Book) -> str:
    """Return how near LoRA with r = R comes to full fine-tuning, which claim 3 does not test."""
    texts = {}
    methods = f"multi/lora_r{book.rank}", "multi/full"
    for backbone in book.complete(*methods):
        prefixes = [f"{backbone}/{method}" for method in methods]
        ratio = statistics.bootstrap(statistics.ratio, *map(book.outcomes, prefixes))
        theirs = published.compute(statistics.ratio, prefixes, book.rank)
        paper = "" if theirs is None else f" ({100 * theirs:.1f})"
        texts[backbone] = f"{percent(ratio)}{paper}"
    if not texts:
        return ""
    return (
        "Claim 3 would also hold if no rank reached 95 % of full fine-tuning's success. LoRA with "
        f"r = {book.rank} reaches, in %, {on_each(texts)}.\n"
    )


def without_state(book: Book) -> str:
    """Return claim 8's first number without one layer of action; "" before its runs."""
    ranks, texts, undecided = {}, {}, []
    for backbone in book.complete("multi/lora_sp"):
        names = naming.flat(book.cells(f"{backbone}/multi/lora_sp"))
        cells = [book.results[name]["layer_active_rank"] for name in names]
        if any(_STATE not in cell["action"] for cell in cells):
            continue
        ranks[backbone] = f"{np.mean([cell['action'][_STATE] for cell in cells]):.0f}"
        with_all = statistics.over_seeds([_vision_ahead(cell) for cell in cells])
        without = statistics.over_seeds([_vision_ahead(cell, _STATE) for cell in cells])
        value, low, high = (signed(x, 2) for x in without)
        texts[backbone] = f"{value} [{low}, {high}]"
        if with_all.high < 0 < without.high:
            undecided.append(BACKBONES[backbone])
    if not texts:
        return ""
    turned = f", so claim 8 could not be told on {' and '.join(undecided)}" if undecided else ""
    return (
        "Claim 8's first number includes one layer of action with a high active rank, the "
        f"projection of the robot's state: {on_each(ranks)}. Without this layer, the number is "
        f"{on_each(texts)}{turned}.\n"
    )


def _vision_ahead(layers: Mapping[str, Mapping[str, list[float]]], left_out: str = "") -> float:
    """Return vision's mean active rank minus the higher of language's and action's."""
    vision, language, action = (
        float(
            np.mean([rank for name, row in layers[t].items() if name != left_out for rank in row])
        )
        for t in TOWERS
    )
    return vision - max(language, action)


def cost_of_cut(book: Book) -> str:
    """Say why LoRA-SP is far ahead of LoRA that is cut after training; "" if the cut is not why."""
    texts = {}
    for backbone in book.complete("multi/lora_sp", "multi/lora_same_rank", "multi/lora_cut"):
        methods = "lora_sp", "lora_same_rank", "lora_cut"
        sp, same, cut = (book.outcomes(f"{backbone}/multi/{m}").mean() for m in methods)
        if same - cut > (sp - cut) / 2 > 0:
            texts[backbone] = f"{100 * same:.1f} %"
    if not texts:
        return ""
    return (
        "Most of claim 10's difference is what the cut costs: LoRA trained with the same rank has "
        f"{on_each(texts)}. The cut is one threshold over all layers, with no training afterwards. "
        "It makes the adapters smaller; LoRA-SP stores its whole bank.\n"
    )
