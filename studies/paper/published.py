"""The paper's own numbers, from paper.json (arXiv 2603.07404v1, Tables I to IV)."""

import functools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

RANK = 128
"""Size of the paper's banks."""


@functools.cache
def _numbers() -> dict[str, Any]:
    return json.loads(Path(__file__).with_name("paper.json").read_text())


def cell(prefix: str, rank: int) -> dict[str, Any]:
    """Return the paper's row for a method, such as "pi0/multi/lora_r16"; {} if it has none.

    LoRA's rank counts as a fraction of `rank`, the size of LoRA-SP's bank.

    Returns:
        "success" by task [%]; where given, "trainable" [%], "active_rank", and "towers", the active
        ranks of vision, language and action.
    """
    backbone, training, method = prefix.split("/")
    if method.startswith("lora_r"):
        share = rank // int(method.removeprefix("lora_r"))
        method = "lora 1" if share == 1 else f"lora 1/{share}"
    found = _numbers()["cells"].get(f"{backbone}/{training}/{method}")
    if found is None:
        return {}
    # All are multiples of 1/15.
    exact = [100 * round(rate * 0.15) / 15 for rate in found["success"]]
    return {**found, "success": dict(zip(_numbers()["tasks"], exact, strict=True))}


def rates(prefix: str, rank: int) -> np.ndarray | None:
    """Return the paper's success rates of a method `[T]`, from 0 to 1; None if it has none."""
    row = cell(prefix, rank)
    return np.array(list(row["success"].values())) / 100 if row else None


def compute(statistic: Callable[..., Any], prefixes: Sequence[str], rank: int) -> Any:
    """Return a function of the paper's `rates` of some methods; None if it lacks one of them."""
    found = [rates(prefix, rank) for prefix in prefixes]
    return None if any(row is None for row in found) else statistic(*found)
