"""Report a command's errors on one line; only bugs show a traceback.

Bad input (ValueError everywhere in this project), inaccessible files and exhausted memory are not
bugs.
"""

import errno
import importlib.metadata
import os
import re
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the judge runs where Rich is not installed
    from rich.console import Console

REFUSED = 2
"""Exit code after bad input."""
INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells report SIGINT."""
MAX_LENGTH = 1000
"""Maximum number of characters in a message."""
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Error numbers of writes that ran out of space."""
_REQUIREMENTS = {"PIL": "pillow", "can": "piper-sdk", "warp": "mujoco-mjx[warp]"}
"""Requirements that bring modules of another name."""


def run_command(
    command: Callable[[], int | None],
    errors: "Console | None" = None,
    interrupted: str = "interrupted",
    remedy: str = "",
) -> int:
    """Run a command and return its exit code, after reporting why it failed.

    Args:
        command: returns the exit code; None means 0.
        errors: console to print to; by default, that of standard error.
        interrupted: printed after Ctrl-C, unless the exception says more.
        remedy: see `report_error`.
    """
    if errors is None:
        from rich.console import Console

        errors = Console(stderr=True)
    try:
        return command() or 0
    except Exception as error:  # prints one sentence for bad input, re-raises bugs
        return report_error(error, errors, remedy)
    except KeyboardInterrupt as stop:
        text = f"interrupted; {stop}" if str(stop) else interrupted
        errors.print(text, soft_wrap=True, highlight=False, markup=False)
        return INTERRUPTED


def report_error(error: Exception, errors: "Console", remedy: str = "") -> int:
    """Print why a command failed.

    Args:
        error: the exception; raised again if it is a bug.
        errors: console to print to.
        remedy: advice to append to the message if disk or memory is full.

    Returns:
        The exit code.
    """
    if (reason := describe(error, remedy)) is None:
        raise error
    # Names on the command line are not always valid Unicode.
    text = f"error: {reason}".encode(errors="backslashreplace").decode()
    errors.print(text, style="red", soft_wrap=True, highlight=False, markup=False)
    return REFUSED


def describe(error: Exception, remedy: str = "") -> str | None:
    """Describe an error on one line; return None for a bug."""
    if isinstance(error, MemoryError) or _is_out_of_memory(error):
        text = "out of memory"
        return f"{text} ({one_line(error)[:200]}){remedy}" if str(error) else f"{text}{remedy}"
    if isinstance(error, ValueError):
        return one_line(error)
    if isinstance(error, ModuleNotFoundError):
        return missing_group(error)
    if not isinstance(error, OSError):
        return None
    if error.strerror is None:  # raised with only a message
        return one_line(error)
    prefix = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
    return f"{prefix}{error.strerror}{remedy if error.errno in DISK_FULL else ''}"


def describe_any(error: BaseException) -> str:
    """Describe an error on one line, a bug with its type."""
    known = describe(error) if isinstance(error, Exception) else None
    return known or ": ".join(filter(None, (type(error).__name__, one_line(error))))


def missing_group(error: ModuleNotFoundError) -> str | None:
    """Say how to install an optional dependency; return None if the module is not one."""
    module = (error.name or "").partition(".")[0]
    name = re.escape(_REQUIREMENTS.get(module, module.replace("_", "-")))
    requirement = re.compile(rf"{name}(?![\w\[-])", re.IGNORECASE)
    groups: dict[str, list[str]] = {}
    try:
        lines = importlib.metadata.requires("lorasp_jax") or ()
    except importlib.metadata.PackageNotFoundError:  # a checkout that is not installed
        return None
    for line in lines:
        if group := re.search(r"extra == ['\"]([\w-]+)", line):
            groups.setdefault(group[1], []).append(line)
    having = [name for name, lines in groups.items() if any(map(requirement.match, lines))]
    if not having:
        return None
    smallest = min(having, key=lambda name: len(groups[name]))
    return f'{module} is not installed: pip install "lorasp_jax[{smallest}]"'


def _is_out_of_memory(error: Exception) -> bool:
    """Return whether a JAX device ran out of memory, judged by type name to avoid importing JAX."""
    return type(error).__name__ == "JaxRuntimeError" and "RESOURCE_EXHAUSTED" in str(error)


def one_line(error: BaseException) -> str:
    """Return the message on one line, cutting out the middle if it is too long."""
    text, half = " ".join(str(error).split()), MAX_LENGTH // 2
    return text if len(text) <= MAX_LENGTH else f"{text[:half]} ... {text[-half:]}"
