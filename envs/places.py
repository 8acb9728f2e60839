"""Where a collection ends up: one process at a time; the old goes when the new is whole."""

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from envs import rlds


@contextlib.contextmanager
def alone(path: Path) -> Iterator[None]:
    """Keeps other processes from making the same file or folder meanwhile.

    A lock file beside it is what they share. The operating system unlocks it when a process ends,
    however it ends.

    Raises:
        ValueError: if another process is at it.
    """
    lock = path.with_name(f".{path.name}.lock")
    lock.parent.mkdir(parents=True, exist_ok=True)
    with open(lock, "w") as held:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not os.path.samestat(os.fstat(held.fileno()), lock.stat()):
                raise FileNotFoundError(lock)  # deleted, and made anew, since it was opened
        except (BlockingIOError, FileNotFoundError) as error:
            raise ValueError(f"another process is collecting into {path}") from error
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


def install(folder: Path, path: Path) -> None:
    """Moves a complete dataset to its place; another one that stands there is replaced.

    Raises:
        ValueError: if something else stands there.
    """
    if path.exists():
        rlds.metadata(path)  # only a dataset is ever deleted
        os.rename(path, _old(path))
    os.rename(folder, path)
    recover(path)


def recover(path: Path) -> None:
    """Ends what `install` began: if it was killed, the old dataset is back or the new one alone."""
    if not path.exists() and _old(path).exists():
        os.rename(_old(path), path)
    elif _old(path).exists():
        shutil.rmtree(_old(path))


def _old(path: Path) -> Path:
    return path.with_name(f".{path.name}.old")
