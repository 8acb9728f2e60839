"""Report compilations that take a long time."""

import contextlib
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Any

import jax

from lorasp_jax.base import _compat

PATIENCE = 2.0
"""Seconds of compilation before a message appears; an arbitrary choice."""


@contextlib.contextmanager
def announce(what: str) -> Iterator[None]:
    """Print a line to stderr if the enclosed compilation exceeds `PATIENCE`, and one when it ends.

    Only the first of several processes prints.
    """
    config = jax.config
    cached = config.jax_enable_compilation_cache and config.jax_compilation_cache_dir is not None
    start = time.monotonic()
    once = " (slow only the first time)" if cached else ""
    timer = threading.Timer(PATIENCE, _print, [f"compiling {what}{once} ..."])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
    seconds = time.monotonic() - start
    if seconds > PATIENCE:
        _print(f"compiled {what} in {seconds:.0f} s")


def _print(line: str) -> None:
    if jax.process_index() == 0:
        print(line, file=sys.stderr, flush=True)


class Calls:
    """Announce method calls on an object that trigger compilation: the first of each kind."""

    def __init__(self, name: str) -> None:
        """Set the name that messages use for the object."""
        self._name = name
        self._called: set[tuple[Any, ...]] = set()

    def first(self, *call: Any) -> AbstractContextManager[None]:
        """Announce a call if it compiles; `call` is its name plus whatever forces a recompile."""
        if call in self._called or not _compat.is_untraced():
            return contextlib.nullcontext()
        self._called.add(call)
        return self.announce(call[0])

    def announce(self, what: str) -> AbstractContextManager[None]:
        """Announce a compilation, unless it is part of an outer trace."""
        if not _compat.is_untraced():
            return contextlib.nullcontext()
        return announce(f"{what} of {self._name}")
