"""Check folders before Orbax opens them, and hide errors that Orbax repeats."""

import logging
import traceback
from pathlib import Path

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
    that is never awaited.
    """
    for name in ("absl", "asyncio"):
        logging.getLogger(name).addFilter(_is_not_from_orbax)


def _is_not_from_orbax(record: logging.LogRecord) -> bool:
    frames = traceback.extract_tb(record.exc_info[2]) if record.exc_info else []
    return not any("/orbax/" in frame.filename for frame in frames)
