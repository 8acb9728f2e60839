"""Let one process compile a program while others that need it wait for the result."""

import contextlib
import threading
import time
from pathlib import Path

import filelock

from lorasp_jax.base.locks import acquire

PATIENCE = 600.0
"""Longest wait for another process [s]; after that, this one compiles the program, too."""

_own = threading.local()


def take(file: Path) -> None:
    """Claim a program for this thread, or wait until another thread or process is done with it.

    Whoever has waited claims nothing: if there is still no program, it was not worth keeping, could
    not be written, or its process was killed, and no one should wait for it again. A thread has at
    most one claim, so threads cannot wait for each other in a circle. The operating system ends the
    claims of a killed process.

    Args:
        file: lock file of the program, in an existing folder. Without a lock, nobody waits.
    """
    end()
    deadline, waited = time.monotonic() + PATIENCE, False
    while time.monotonic() < deadline:
        try:
            lock = acquire(file)
        except filelock.Timeout:
            waited = True
            continue
        except ValueError:  # read-only, or not lockable
            return
        _own.claim = contextlib.ExitStack()
        _own.claim.enter_context(lock)
        _own.claim.callback(file.unlink, missing_ok=True)
        if waited:
            end()
        return


def end() -> None:
    """End this thread's claim, if it has one."""
    with contextlib.suppress(OSError):
        getattr(_own, "claim", contextlib.ExitStack()).close()
