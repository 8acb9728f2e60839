"""Says what is being compiled, where a user would otherwise wait in silence."""

import contextlib
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Any

import jax

from envs import _compat

PATIENCE = 2.0
"""Seconds that nobody minds."""


@contextlib.contextmanager
def said(what: str) -> Iterator[None]:
    """Around work that compiles: one line on stderr if it takes long, and one when it is done.

    Only the first of several processes says anything.

    Args:
        what: what is compiled, in words.
    """
    config = jax.config
    kept = config.jax_enable_compilation_cache and config.jax_compilation_cache_dir is not None
    begun = time.monotonic()
    once = " (long the first time only)" if kept else ""
    line = threading.Timer(PATIENCE, _say, [f"compiling {what}{once} ..."])
    line.daemon = True
    line.start()
    try:
        yield
    finally:
        line.cancel()
    seconds = time.monotonic() - begun
    if seconds > PATIENCE:
        hint = "" if kept else "; envs.compilation.cache.enable() keeps it for the next start"
        _say(f"compiled {what} in {seconds:.0f} s{hint}")


def _say(line: str) -> None:
    if jax.process_index() == 0:
        print(line, file=sys.stderr, flush=True)


class Calls:
    """The calls of one object, of which the first of each kind compiles."""

    def __init__(self, name: str) -> None:
        """Name what is called, for the user."""
        self._name = name
        self._called: set[tuple[Any, ...]] = set()

    def first(self, *call: Any) -> AbstractContextManager[None]:
        """Around a call: what is called, and what else decides whether it is compiled anew."""
        if call in self._called or not _compat.is_untraced():
            return contextlib.nullcontext()
        self._called.add(call)
        return self.said(call[0])

    def said(self, what: str) -> AbstractContextManager[None]:
        """As `said`, unless this becomes a part of something that others compile."""
        if not _compat.is_untraced():
            return contextlib.nullcontext()
        return said(f"{what} of {self._name}")
