"""A file or folder that one process at a time makes."""

import contextlib
import fcntl
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TextIO

from envs.datasets.files import check_local


@contextlib.contextmanager
def alone(path: Path, waiting: Callable[[], None] | None = None) -> Iterator[None]:
    """Keeps other processes from making the same file or folder meanwhile.

    A lock file beside it is what they share. The operating system unlocks it when a process ends,
    however it ends. Where something is raised inside, empty folders made for it go again.

    Args:
        path: the file or folder.
        waiting: called once if another process is at it, whose end is then waited for; None: not
            waited for.

    Raises:
        ValueError: if another process is at it and is not waited for, the path is a URL, or as
            `open_lock`.
    """
    check_local(path)
    missing = [folder for folder in path.parents if not folder.exists()]
    try:
        with _locked(path, waiting):
            yield
    except BaseException:
        for folder in missing:
            with contextlib.suppress(OSError):  # it is not empty, or was not made
                folder.rmdir()
        raise


@contextlib.contextmanager
def _locked(path: Path, waiting: Callable[[], None] | None) -> Iterator[None]:
    """`alone`, but for the folders."""
    lock = path.with_name(f".{path.name}.lock")
    how = fcntl.LOCK_EX | fcntl.LOCK_NB
    while True:
        with open_lock(lock) as held:
            try:
                fcntl.flock(held, how)
            except BlockingIOError as error:
                if waiting is None:
                    raise ValueError(f"another process is writing {path}") from error
                waiting()
                how = fcntl.LOCK_EX
                continue
            if _was_deleted(held, lock):  # by the process that had it, since it was opened
                continue
            try:
                yield
            finally:
                lock.unlink(missing_ok=True)
            return


def open_lock(path: Path) -> TextIO:
    """A lock file, made where there is none.

    Raises:
        ValueError: it cannot be opened.
    """
    # Not through a link: the file that it leads to is not ours to make, to write or to wait for.
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return os.fdopen(os.open(path, flags, 0o666), "a+")
    except OSError as error:
        raise ValueError(f"{error.filename or path} cannot be opened: {error.strerror}") from error


def _was_deleted(file: TextIO, path: Path) -> bool:
    """Whether an open file is no longer the one at its path."""
    try:
        return not os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return True
