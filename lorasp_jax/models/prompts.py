"""Instructions as the published language models read them."""

import numpy as np

STATE_BINS = 256
"""Bins of [-1, 1] that pi0.5 names a state's numbers by."""


def openpi(text: str) -> str:
    """What openpi makes of an instruction for pi0, before the newline that starts the answer.

    Blanks at both ends go; underscores and newlines become blanks (openpi, models/tokenizer.py).
    """
    return text.strip().replace("_", " ").replace("\n", " ")


def lerobot(text: str) -> str:
    """The instruction as it is, with a newline at its end (LeRobot, newline_task_processor.py)."""
    return text if text.endswith("\n") else f"{text}\n"


def pi05(text: str, state: np.ndarray) -> str:
    """The whole prompt of pi0.5, in openpi and LeRobot alike.

    Args:
        text: instruction.
        state: `[A]`, normalised; what is below -1 is named -1, what is at or above 1 is named 255.
    """
    edges = np.linspace(-1, 1, STATE_BINS + 1)[:-1]
    numbers = np.digitize(state, edges) - 1
    return f"Task: {openpi(text)}, State: {' '.join(map(str, numbers))};\nAction: "
