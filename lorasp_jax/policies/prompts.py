"""Prompt templates of published policies."""

import numpy as np

STATE_BINS = 256
"""Number of bins of [-1, 1] into which pi0.5 discretizes the state."""
EDGES = np.linspace(-1, 1, STATE_BINS + 1)[:-1]
"""Lower edges of the bins, exact in fp32."""
PI05_END = ";\nAction: "
"""Text after the state in the prompt of pi0.5."""


def openpi(text: str) -> str:
    """Clean an instruction as openpi does for pi0, without the newline that precedes the answer.

    Strip whitespace; replace underscores and newlines with spaces (openpi, models/tokenizer.py).
    """
    return text.strip().replace("_", " ").replace("\n", " ")


def lerobot(text: str) -> str:
    """Append a newline unless the text ends in one (LeRobot, newline_task_processor.py)."""
    return text if text.endswith("\n") else f"{text}\n"


def pi05(text: str, state: np.ndarray) -> str:
    """Return the full prompt of pi0.5, as openpi (models/tokenizer.py) and LeRobot
    (processor_pi05.py) write it.

    Args:
        text: instruction.
        state: `[J+1]`, normalized; values below -1 are written as -1, values of 1 or more as 255.
    """
    bins = np.digitize(state, EDGES) - 1
    return f"{pi05_start(text)} {' '.join(map(str, bins))}{PI05_END}"


def pi05_start(text: str) -> str:
    """Return pi0.5's prompt up to the space before the first state value."""
    return f"Task: {openpi(text)}, State:"
