"""Atomic writes of files and folders: write under a temporary name, then rename.

Contents are synced to disk before the rename, and the rename before the call returns. A crash or a
power failure thus never leaves a partial file under the final name. If a write fails, the temporary
file is deleted and the old file is kept.
"""

import contextlib
import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

TEMPORARY_SUFFIX = ".tmp"
"""Suffix of temporary names, which also start with a dot."""


@contextlib.contextmanager
def atomic_file(file: Path) -> Iterator[Path]:
    """Yield a temporary path to write to; it replaces the file if the block succeeds.

    Raises:
        OSError: the file cannot be written, for example to a full disk.
    """
    temporary = file.with_name(f".{file.name}.{secrets.token_hex(4)}{TEMPORARY_SUFFIX}")
    try:
        yield temporary
        sync(temporary)
        os.replace(temporary, file)
        sync(file.parent)
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(file: Path, data: bytes | bytearray) -> None:
    """Replace a file (see `atomic_file`)."""
    with atomic_file(file) as temporary:
        temporary.write_bytes(data)


def write_text(file: Path, text: str) -> None:
    """Replace a text file in UTF-8 (see `atomic_file`)."""
    write_bytes(file, text.encode())


@contextlib.contextmanager
def atomic_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a new folder to fill, which is renamed to `path` if the block succeeds.

    Leftovers of a killed process are deleted first, so only one process at a time may create a path
    (see `lorasp_jax.base.locks.locked`).

    Raises:
        ValueError: the path already exists.
        OSError: something cannot be written, for example to a full disk.
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


def rename(old: Path, new: Path) -> None:
    """Rename a file or folder within a file system, and sync the new name to disk."""
    os.rename(old, new)
    sync(new.parent)


def sync(path: Path) -> None:
    """Wait until a file's content, or the entries of a folder, are on disk.

    Raises:
        OSError: the data cannot be written, for example to a full disk.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # some file systems (SMB) cannot sync folders
            raise
    finally:
        os.close(descriptor)
