"""What a command says of what it cannot use: one sentence, while our own mistakes keep a traceback.

Bad input raises ValueError everywhere in the project. A file that cannot be opened, read or written
and memory that does not suffice are the machine's.
"""

import errno
import os

from rich.console import Console

REFUSED = 2
"""Exit code after bad input."""
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Numbers of the errors of a write for which there is no room."""


def refused(error: Exception, errors: Console, remedy: str = "") -> int:
    """Say why a command cannot go on.

    Args:
        error: what ended it; raised again where it is neither the input's fault nor the machine's.
        errors: where to say it.
        remedy: what may be done where a disk or memory is full.

    Returns:
        The exit code.
    """
    if (reason := sentence(error, remedy)) is None:
        raise error
    # A name on the command line need not be text.
    text = f"error: {reason}".encode(errors="backslashreplace").decode()
    errors.print(text, style="red", soft_wrap=True, highlight=False, markup=False)
    return REFUSED


def sentence(error: Exception, remedy: str = "") -> str | None:
    """The reason on one line; None if it is a mistake of ours."""
    if isinstance(error, MemoryError) or _exhausted(error):
        text = "this needs more memory than there is"
        return f"{text} ({_line(error)[:200]}){remedy}" if str(error) else f"{text}{remedy}"
    if isinstance(error, ValueError):
        return _line(error)
    if not isinstance(error, OSError):
        return None
    if error.strerror is None:  # raised by hand
        return _line(error)
    named = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
    return f"{named}{error.strerror}{remedy if error.errno in DISK_FULL else ''}"


def _exhausted(error: Exception) -> bool:
    """Whether a device of JAX had no memory; JAX' own class is of no use where it is not loaded."""
    return type(error).__name__ == "JaxRuntimeError" and "RESOURCE_EXHAUSTED" in str(error)


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
