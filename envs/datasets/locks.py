"""A file or folder that one process at a time may write."""

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import filelock

from envs.datasets.files import check_local

_RETRY = 0.2  # seconds; a lock file deleted by its last holder is made anew at the second attempt


@contextlib.contextmanager
def locked(path: Path, waiting: Callable[[], None] | None = None) -> Iterator[None]:
    """Keep other processes and threads from writing the same file or folder meanwhile.

    They share a lock file beside it, which is deleted at the end. If something is raised inside,
    empty folders that were made for it are deleted, too.

    Args:
        path: the file or folder.
        waiting: called once if another process holds the lock, which is then waited for; None: that
            is an error.

    Raises:
        ValueError: another process holds the lock and `waiting` is None, the path is a URL, or as
            `acquire`.
    """
    check_local(path)
    missing = [folder for folder in path.parents if not folder.exists()]
    file = path.with_name(f".{path.name}.lock")
    try:
        try:
            lock = acquire(file)
        except filelock.Timeout as error:
            if waiting is None:
                raise ValueError(f"another process is writing {path}") from error
            waiting()
            lock = acquire(file, wait=True)
        with lock:
            try:
                yield
            finally:
                file.unlink(missing_ok=True)
    except BaseException:
        for folder in missing:
            with contextlib.suppress(OSError):  # it is not empty, or was not made
                folder.rmdir()
        raise


def acquire(file: Path, *, wait: bool = False) -> AbstractContextManager[Any]:
    """Lock a file, made where there is none; the lock is released at the end of a `with` block.

    The operating system releases it when the process ends, in whatever way.

    Args:
        file: the lock file itself.
        wait: until no other process holds the lock.

    Raises:
        filelock.Timeout: another process holds the lock, and it is not waited for.
        ValueError: the file cannot be opened or locked.
    """
    try:
        if file.is_fifo():
            raise OSError(None, "it is a pipe", str(file))
        lock = filelock.FileLock(file, fallback_to_soft=False)
        return lock.acquire(timeout=-1 if wait else _RETRY)
    except filelock.Timeout:  # an OSError, too
        raise
    except OSError as error:
        raise ValueError(f"{error.filename or file} cannot be opened: {error.strerror}") from error
