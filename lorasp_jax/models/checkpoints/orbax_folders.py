"""Check folders before Orbax opens them, and hide errors that Orbax repeats."""

import asyncio
import functools
import logging
import sys
import traceback
from pathlib import Path
from types import TracebackType
from typing import Any

from lorasp_jax.base.files import check_memory, check_only_files


def check(folder: Path) -> None:
    """Raise if opening a folder could make Orbax's C++ code hang or crash this process.

    Raises:
        RefusedError: an entry is too large or is neither a regular file nor a folder.
        OSError: a link is broken or a file is not readable.
    """
    check_only_files(folder)
    for path in folder.rglob("*"):
        check_memory(path.stat().st_size, path)


def suppress_repeated_errors() -> None:
    """After a failed read or write, report only the exception that Orbax raises.

    Otherwise Orbax logs a traceback for every other failed operation, and asyncio for every task
    that is never awaited. Python also prints errors from Orbax's threads and coroutines.
    """
    for name in ("absl", "asyncio"):
        logging.getLogger(name).addFilter(_is_not_from_orbax)
    _filter_unraisable_errors()


def _is_not_from_orbax(record: logging.LogRecord) -> bool:
    return not (record.exc_info and _is_from_orbax(record.exc_info[2]))


@functools.cache  # install the hook once per process
def _filter_unraisable_errors() -> None:
    """Hide Orbax's errors from `sys.unraisablehook`."""
    original = sys.unraisablehook

    def hook(unraisable: Any) -> None:
        if not _is_from_orbax(unraisable.exc_traceback):
            original(unraisable)

    sys.unraisablehook = hook


def _is_from_orbax(raised: TracebackType | None) -> bool:
    """Whether an exception comes from Orbax, or from a thread whose event loop was closed."""
    frames = traceback.extract_tb(raised)
    closed = bool(frames) and frames[0].filename == asyncio.base_events.__file__
    return closed or any("/orbax/" in frame.filename for frame in frames)
