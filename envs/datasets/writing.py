"""Write files and folders aside, then rename them: others see the old one or the new one, whole.

Everything is on disk before it gets its name, and so is the name when the call returns: after a
power cut, too, a name never stands for half a file. Where anything is raised, a full disk for
example, nothing is left behind and the old file stays.
"""

import contextlib
import errno
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

TEMPORARY_SUFFIX = ".tmp"
"""How a name ends that a file or folder has until it is whole; it begins with a dot."""


@contextlib.contextmanager
def atomic_file(file: Path) -> Iterator[Path]:
    """A path to write to, which replaces the file when the block ends without an exception.

    Raises:
        OSError: the file cannot be written, for want of room for example.
    """
    unfinished = file.with_name(f".{file.name}.{secrets.token_hex(4)}{TEMPORARY_SUFFIX}")
    try:
        yield unfinished
        sync(unfinished)
        os.replace(unfinished, file)
        sync(file.parent)
    finally:
        unfinished.unlink(missing_ok=True)


def write_bytes(file: Path, data: bytes | bytearray) -> None:
    """Replace a file, see `atomic_file`."""
    with atomic_file(file) as unfinished:
        unfinished.write_bytes(data)


def write_text(file: Path, text: str) -> None:
    """Replace a text file in UTF-8, see `atomic_file`."""
    write_bytes(file, text.encode())


@contextlib.contextmanager
def atomic_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A new folder to fill, which is renamed to `path` when the block ends without an exception.

    One process at a time may create a path (`envs.datasets.locks.locked`): what a killed one left
    is deleted first.

    Raises:
        ValueError: the path already exists.
        OSError: something cannot be written, for want of room for example.
    """
    path = Path(path)
    if path.exists():
        raise ValueError(f"{path} already exists: choose another path")
    folder = path.with_name(f".{path.name}{TEMPORARY_SUFFIX}")
    if folder.exists():
        shutil.rmtree(folder)
    try:
        folder.mkdir(parents=True)
        yield folder
        for content in folder.rglob("*"):
            sync(content)
        sync(folder)
        rename(folder, path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def replace_folder(new: Path, path: Path, check: Callable[[Path], object]) -> None:
    """Rename a complete folder to `path`; one that stands there is deleted afterwards.

    Args:
        new: the complete folder.
        path: its new name. After a kill, `recover_folder` ends what was begun.
        check: called with `path` where something stands there; raises if that must not be deleted.
    """
    if path.exists():
        check(path)
        rename(path, _old(path))
    rename(new, path)
    recover_folder(path)


def recover_folder(path: Path) -> None:
    """After a killed `replace_folder`: keep the new folder if it is in place, else the old one."""
    if not path.exists() and _old(path).exists():
        rename(_old(path), path)
    elif _old(path).exists():
        shutil.rmtree(_old(path))


def rename(old: Path, new: Path) -> None:
    """Rename a file or folder within its file system; the new name is on disk afterwards."""
    os.rename(old, new)
    sync(new.parent)


def sync(path: Path) -> None:
    """Wait until a file's content, or the names in a folder, are on disk.

    Raises:
        OSError: they cannot be written, for want of room for example.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # not a file system's (SMB) that cannot sync folders
            raise
    finally:
        os.close(descriptor)


def _old(path: Path) -> Path:
    return path.with_name(f".{path.name}.old")
