"""Where LoRA-SP spends its rank, in words."""

from collections.abc import Mapping

import numpy as np

from studies.paper import naming
from studies.paper.book import BACKBONES, Book
from studies.paper.naming import TOWERS

_EXTREMES = 3
"""Kinds of layers to name at each end."""
Boxes = Mapping[str, Mapping[str, np.ndarray]]
"""See `Book.rank_boxes`."""


def where_rank_goes(book: Book) -> str:
    """Return a paragraph for each backbone."""
    return "\n".join(f"**{BACKBONES[b]}**: {_paragraph(book, b)}" for b in book.backbones)


def _paragraph(book: Book, backbone: str) -> str:
    prefix = f"{backbone}/multi/lora_sp"
    if missing := book.missing(prefix):
        return f"{missing}.\n"
    boxes = book.rank_boxes(prefix)
    means = {tower: book.mean(prefix, "active_rank", tower) or 0.0 for tower in TOWERS}
    spread = {
        t: float(np.mean([(b[..., 3] - b[..., 1]).mean() for b in boxes[t].values()]))
        for t in TOWERS
    }
    high, low = _extremes(boxes)
    return (
        f"on average, a token uses {_by_tower(means, f' of {book.rank} directions')}."
        '\n\n<details markdown="1">\n<summary>Layers, depth and tokens</summary>\n\n'
        f"The median over tokens is highest in {high}, and lowest in {low}. "
        f"From the first layer to the last, it goes {_by_tower(_depth(boxes))}. "
        f"Within one layer, the middle half of the tokens spans {_by_tower(spread, ' ranks')}."
        "\n\n</details>\n"
    )


def _extremes(boxes: Boxes) -> tuple[str, str]:
    """Return the kinds of layers with the highest and the lowest medians."""
    medians = {
        f"{tower} `{naming.short_kind(kind)}`": float(array[..., 2].mean())
        for tower, kinds in boxes.items()
        for kind, array in kinds.items()
    }
    ordered = sorted(medians, key=lambda name: -medians[name])
    ends = ordered[:_EXTREMES], ordered[::-1][:_EXTREMES]
    high, low = (", ".join(f"{name} ({medians[name]:.0f})" for name in end) for end in ends)
    return high, low


def _depth(boxes: Boxes) -> dict[str, str]:
    """Return the medians of the first and the last layers, averaged over kinds, by tower."""
    found = {}
    for tower in TOWERS:
        stacks = [array[..., 2].mean(0) for array in boxes[tower].values() if array.shape[1] > 1]
        if stacks:
            first, last = (np.mean([stack[end] for stack in stacks]) for end in (0, -1))
            found[tower] = f"from {first:.0f} to {last:.0f}"
    return found


def _by_tower(values: Mapping[str, float | str], unit: str = "") -> str:
    """Return values by tower, such as "30.1 ranks in vision, 11.0 in language and ..."."""
    texts = {t: v if isinstance(v, str) else f"{v:.1f}" for t, v in values.items()}
    parts = [f"{text}{'' if n else unit} in {t}" for n, (t, text) in enumerate(texts.items())]
    return " and ".join(", ".join(parts).rsplit(", ", 1))
