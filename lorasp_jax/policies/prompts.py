"""Instructions as the published language models read them."""

import numpy as np

STATE_BINS = 256
"""Bins of [-1, 1] that pi0.5 names a state's numbers by."""
EDGES = np.linspace(-1, 1, STATE_BINS + 1)[:-1]
"""Lower edges of the bins, exact in fp32."""
PI05_END = ";\nAction: "
"""What follows the numbers in the prompt of pi0.5."""


def openpi(text: str) -> str:
    """What openpi makes of an instruction for pi0, before the newline that starts the answer.

    Blanks at both ends go; underscores and newlines become blanks (openpi, models/tokenizer.py).
    """
    return text.strip().replace("_", " ").replace("\n", " ")


def lerobot(text: str) -> str:
    """The instruction as it is, with a newline at its end (LeRobot, newline_task_processor.py)."""
    return text if text.endswith("\n") else f"{text}\n"


def pi05(text: str, state: np.ndarray) -> str:
    """The whole prompt of pi0.5, in openpi (models/tokenizer.py) and LeRobot (processor_pi05.py).

    Args:
        text: instruction.
        state: `[J+1]`, the robot's normalised numbers; what is below -1 is
            named -1, what is at or above 1 is named 255.
    """
    numbers = np.digitize(state, EDGES) - 1
    return f"{pi05_start(text)} {' '.join(map(str, numbers))}{PI05_END}"


def pi05_start(text: str) -> str:
    """What of pi0.5's prompt stands before the blank and the first number."""
    return f"Task: {openpi(text)}, State:"
