"""Folders of Orbax: what is checked before it opens one, and what it must not print."""

import asyncio
import functools
import logging
import sys
import traceback
from pathlib import Path
from types import TracebackType
from typing import Any

from envs.datasets.files import TEXT_BYTES, RefusedError, check_memory, check_only_files

MANIFEST = "manifest.ocdbt"
"""Where TensorStore's database begins, in one or more folders; it is read at once."""


def check(folder: Path) -> None:
    """Raise unless a folder can be given to Orbax, whose C++ would wait or end this process.

    Raises:
        RefusedError: something in it is no file, or larger than what can be.
        OSError: a link leads to nothing, or a file must not be read.
    """
    check_only_files(folder)
    for path in folder.rglob("*"):
        size = path.stat().st_size
        check_memory(size, path)
        if path.name == MANIFEST and size > TEXT_BYTES:
            raise RefusedError(f"{path} has {size} bytes; it may have {TEXT_BYTES}")


def leave_echoes_out() -> None:
    """Of reads and writes that fail say nothing but what Orbax raises of the first.

    Of the others Orbax logs a traceback each, asyncio one for each task that nobody waits for, and
    Python prints what their threads and forgotten coroutines raise.
    """
    for name in ("absl", "asyncio"):
        logging.getLogger(name).addFilter(_is_news)
    _hook_echoes()


def _is_news(record: logging.LogRecord) -> bool:
    """Whether a log record says more than an exception will."""
    return not (record.exc_info and _is_echo(record.exc_info[2]))


@functools.cache  # once a process
def _hook_echoes() -> None:
    """Let echoes pass `sys.unraisablehook` unsaid."""
    before = sys.unraisablehook

    def hook(failed: Any) -> None:
        if not _is_echo(failed.exc_traceback):
            before(failed)

    sys.unraisablehook = hook


def _is_echo(raised: TracebackType | None) -> bool:
    """Whether an exception comes from Orbax, or from a thread that finds its event loop closed."""
    frames = traceback.extract_tb(raised)
    closed = bool(frames) and frames[0].filename == asyncio.base_events.__file__
    return closed or any("/orbax/" in frame.filename for frame in frames)
