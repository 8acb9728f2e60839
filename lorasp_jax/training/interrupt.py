"""Ctrl-C and SIGTERM: save first, then stop."""

import contextlib
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import FrameType

_MESSAGE = b"stopping at the next log step; another signal stops immediately\n"


@dataclass
class Stop:
    """Flag set by a signal that asks the run to stop."""

    requested: bool = False


@contextlib.contextmanager
def deferred() -> Iterator[Stop]:
    """In this block the first SIGINT or SIGTERM sets a flag; the second raises KeyboardInterrupt.

    The caller checks the flag where the training state can be saved.
    """
    stop = Stop()

    def handle(_number: int, _frame: FrameType | None) -> None:
        if stop.requested:
            raise KeyboardInterrupt
        stop.requested = True
        os.write(1, _MESSAGE)  # print is not reentrant: it would raise inside another print

    with _handlers(handle):
        yield stop


@contextlib.contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """Inside this block SIGTERM raises KeyboardInterrupt, like Ctrl-C."""
    with _handlers(signal.default_int_handler):
        yield


@contextlib.contextmanager
def _handlers(handle: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Install `handle` for both signals and restore the previous handlers afterwards."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    previous = [signal.signal(number, handle) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, previous, strict=True):
            signal.signal(number, handler)
