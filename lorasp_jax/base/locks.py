"""Locks that let one process at a time write a file or folder."""

import contextlib
import os
import platform
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import filelock

from lorasp_jax.base.files import check_local

_RETRY = 0.2  # s, long enough for a second attempt if the last holder deletes the lock file


@contextlib.contextmanager
def locked(path: Path, waiting: Callable[[], None] | None = None) -> Iterator[None]:
    """Keep other processes and threads from writing the same file or folder.

    The lock is a file next to the path, which names its holder and is deleted at the end. If the
    block raises, empty folders created for it are deleted, too.

    Args:
        path: the file or folder.
        waiting: called before waiting for another process that holds the lock; None: raise instead.

    Raises:
        ValueError: another process holds the lock and `waiting` is None, the path is a URL, or the
            lock file cannot be opened.
    """
    check_local(path)
    missing = [folder for folder in path.parents if not folder.exists()]
    file = path.with_name(f".{path.name}.lock")
    try:
        try:
            lock = acquire(file)
        except filelock.Timeout as error:
            if waiting is None:
                remedy = "wait for it, stop it or choose another name"
                raise ValueError(f"{path} is in use by {_holder(file)}: {remedy}") from error
            waiting()
            lock = acquire(file, wait=True)
        with lock:
            try:
                file.write_text(f"process {os.getpid()} on {platform.node()}\n")
                yield
            finally:
                file.unlink(missing_ok=True)
    except BaseException:
        for folder in missing:
            with contextlib.suppress(OSError):  # not empty, or never created
                folder.rmdir()
        raise


def _holder(file: Path) -> str:
    """Return the process that holds a lock, whose file it may be deleting."""
    text = ""
    with contextlib.suppress(FileNotFoundError):
        text = file.read_text().strip()
    return text or "another process"


def acquire(file: Path, *, wait: bool = False) -> AbstractContextManager[Any]:
    """Lock a file, creating it if necessary; use the result in a `with` block.

    The operating system releases the lock when the process ends, even if it is killed.

    Args:
        file: the lock file itself.
        wait: wait until no other process holds the lock.

    Raises:
        filelock.Timeout: another process holds the lock and `wait` is False.
        ValueError: the file cannot be opened or locked.
    """
    try:
        lock = filelock.FileLock(file, fallback_to_soft=False)
        return lock.acquire(timeout=-1 if wait else _RETRY)
    except filelock.Timeout:  # also an OSError
        raise
    except OSError as error:
        raise ValueError(f"cannot open {error.filename or file}: {error.strerror}") from error
