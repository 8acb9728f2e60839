"""Prompt templates of published policies, and padding."""

import warnings
from collections.abc import Sequence

import numpy as np

STATE_BINS = 256
"""Number of equal bins over [-1, 1] for the state in pi0.5's prompt."""
EDGES = np.linspace(-1, 1, STATE_BINS + 1)[:-1]
"""Lower edges of the bins, exact in fp32."""
ADVANTAGE = (", Advantage: positive", ", Advantage: negative", "")
"""What follows an instruction if the action is good, bad, or the policy is not told (RECAP)."""
ADVANTAGE_SHORT = ("+", "-", "")
"""The same in one token, for the offline tokenizer, which would spell the words."""
PI05_END = ";\nAction: "
"""Text after the state in the prompt of pi0.5."""


def openpi(text: str) -> str:
    """Clean an instruction as openpi does for pi0 (models/tokenizer.py).

    Surrounding whitespace is stripped; underscores and newlines inside become spaces. The newline
    that openpi appends is not added.
    """
    return text.strip().replace("_", " ").replace("\n", " ")


def lerobot(text: str) -> str:
    """Append a newline unless the text ends in one (LeRobot, newline_task_processor.py)."""
    return text if text.endswith("\n") else f"{text}\n"


def pi05(text: str, state: np.ndarray) -> str:
    """Return the full prompt of pi0.5, as in openpi (models/tokenizer.py).

    LeRobot's is the same (processor_pi05.py).

    Args:
        text: instruction.
        state: `[J+1]`, normalized. Values below -1 become bin -1, values of 1 or more bin 255.
    """
    bins = np.digitize(state, EDGES) - 1
    return f"{pi05_start(text)} {' '.join(map(str, bins))}{PI05_END}"


def pi05_start(text: str) -> str:
    """Return pi0.5's prompt up to the space before the first state value."""
    return f"Task: {openpi(text)}, State:"


def pad(
    texts: Sequence[str], rows: Sequence[Sequence[int]], max_tokens: int, pad: int
) -> tuple[np.ndarray, np.ndarray]:
    """Truncate or right-pad the rows to ids `[P, T]` int32 and valid `[P, T]` bool."""
    ids = np.full((len(rows), max_tokens), pad, np.int32)
    valid = np.zeros((len(rows), max_tokens), bool)
    for i, (text, row) in enumerate(zip(texts, rows, strict=True)):
        if len(row) > max_tokens:
            warnings.warn(
                f"{text!r} has {len(row)} tokens; truncated to {max_tokens}", stacklevel=3
            )
        ids[i, : len(row)] = row[:max_tokens]
        valid[i, : len(row)] = True
    return ids, valid
