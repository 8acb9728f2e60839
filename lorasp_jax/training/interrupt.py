"""Ctrl-C and SIGTERM: save first, then stop."""

import contextlib
import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from types import FrameType

from lorasp_jax.base.signals import handled

_NUMBERS = signal.SIGINT, signal.SIGTERM
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

    with handled(_NUMBERS, handle):
        yield stop


@contextlib.contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """Inside this block SIGTERM raises KeyboardInterrupt, like Ctrl-C."""
    with handled(_NUMBERS, signal.default_int_handler):
        yield
