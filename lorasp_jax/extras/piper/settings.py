"""How a policy's chunks are executed."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """How a policy's chunks are executed.

    Attributes:
        prompt: the request in words.
        control_dt: duration of an action [s], as in the policy's training.
        execute: actions of each chunk that are executed.
        ahead: how many actions before the end of these the next chunk is asked for. At 0 the arm
            waits for the answer. Otherwise the new chunk counts from when it was asked for, and
            takes over when the action ends during which it arrives: its first actions are then in
            the past. If it arrives after the end of the previous chunk, the arm has waited.
        patience: longest time to wait for an answer [s].
        hold: time to hold, after which the arm goes to rest [s].
        dry_run: print commands instead of sending them.
    """

    prompt: str
    control_dt: float = 0.1
    execute: int = 5
    ahead: int = 0
    patience: float = 2.0
    hold: float = 3.0
    dry_run: bool = False

    def __post_init__(self) -> None:
        """Raise ValueError if a number is out of range."""
        if not 0 <= self.ahead < self.execute:
            raise ValueError(f"ahead must be 0 to {self.execute - 1}, got {self.ahead}")
        for name in ("control_dt", "patience", "hold"):
            if not 0 < (value := getattr(self, name)) < math.inf:
                raise ValueError(f"{name} must be above 0 s and finite, got {value}")
