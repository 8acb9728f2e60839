"""Time that never jumps: steps of the system's clock, by NTP or by hand, change nothing here."""

import time
from typing import Protocol


class Clock(Protocol):
    """A clock that one control loop waits on."""

    def now(self) -> float:
        """Return the time since an arbitrary start [s]."""
        ...

    def wait_until(self, seconds: float) -> None:
        """Return at a time on this clock, at once if it has passed."""
        ...


class RealClock:
    """The machine's monotonic clock."""

    def now(self) -> float:
        """Return the time since an arbitrary start [s]."""
        return time.monotonic()

    def wait_until(self, seconds: float) -> None:
        """Sleep until a time on this clock."""
        time.sleep(max(0.0, seconds - time.monotonic()))
