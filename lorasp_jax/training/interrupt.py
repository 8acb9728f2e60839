"""Ctrl-C and SIGTERM: save first, then stop."""

import contextlib
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import FrameType

_SAID = b"stopping at the next log line; once more stops at once\n"


@dataclass
class Stop:
    """Whether a signal asked the run to stop."""

    requested: bool = False


@contextlib.contextmanager
def deferred() -> Iterator[Stop]:
    """Inside this block the first SIGINT or SIGTERM only sets a flag; a second one interrupts.

    The caller looks at the flag where its state is whole and can be saved.
    """
    stop = Stop()

    def handle(_number: int, _frame: FrameType | None) -> None:
        if stop.requested:
            raise KeyboardInterrupt
        stop.requested = True
        os.write(1, _SAID)  # print raises where the signal finds this thread printing

    with _handlers(handle):
        yield stop


@contextlib.contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """Inside this block SIGTERM raises KeyboardInterrupt, as Ctrl-C does."""

    def handle(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    with _handlers(handle):
        yield


@contextlib.contextmanager
def _handlers(handle: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Install `handle` for both signals and put the former handlers back."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, handle) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
