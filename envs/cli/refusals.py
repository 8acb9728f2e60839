"""What a command says of what it cannot use: one sentence, while our own mistakes keep a traceback.

Bad input raises ValueError everywhere in the project. A file that cannot be opened, read or written
and memory that does not suffice are the machine's. Who stops reading has nothing to be told.
"""

import argparse
import errno
import os
import select
import sys
from collections.abc import Sequence

from rich.console import Console

REFUSED = 2
"""Exit code after bad input."""
UNREAD = 141
"""Exit code after the reader of what is printed left, as shells have it of SIGPIPE."""
LONGEST = 1000
"""Characters of a reason that are said."""
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Numbers of the errors of a write for which there is no room."""
_STDOUT = 1


def parsed(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    """The options of a command.

    Raises:
        SystemExit: after help or bad options, as argparse does; `UNREAD` if nobody reads the help.
    """
    try:
        return parser.parse_args(arguments)
    except SystemExit:
        try:
            sys.stdout.flush()  # else Python does at its end, and complains
        except BrokenPipeError as error:
            if _reader_left():
                raise SystemExit(UNREAD) from error
            raise
        raise


def refused(error: Exception, errors: Console, remedy: str = "") -> int:
    """Say why a command cannot go on.

    Args:
        error: what ended it; raised again where it is neither the input's fault nor the machine's.
        errors: where to say it.
        remedy: what may be done where a disk or memory is full.

    Returns:
        The exit code.
    """
    if isinstance(error, BrokenPipeError) and _reader_left():
        return UNREAD
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


def _reader_left() -> bool:
    """Whether nobody reads what this process prints, which is then dropped."""
    poll = select.poll()
    poll.register(_STDOUT, select.POLLOUT)
    if not any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0)):
        return False
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, _STDOUT)  # Python tries once more at its end, and complains
    os.close(nowhere)
    return True


def _exhausted(error: Exception) -> bool:
    """Whether a device of JAX had no memory; JAX' own class is of no use where it is not loaded."""
    return type(error).__name__ == "JaxRuntimeError" and "RESOURCE_EXHAUSTED" in str(error)


def _line(error: Exception) -> str:
    """Its text on one line, of a long one the two ends: it quotes what may be a whole file."""
    text = " ".join(str(error).split())
    return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"
