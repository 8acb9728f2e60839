"""Files of others, of which nothing is trusted: where they are, what they are, how large they are.

A name in a dataset or a model may be a URL, lead out of its folder or be that of a pipe; a size in
it may be more than any memory. Whoever opens such a file asks here first.
"""

import contextlib
import json
import os
import re
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

TEXT_BYTES = 2**30
"""Largest file that is read at once: as text, a million episodes take a tenth of it."""
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")
_FAILURES = (OSError, ValueError, LookupError, TypeError, AttributeError, EOFError, ArithmeticError)
_FAILURES += (RuntimeError, ImportError)  # RecursionError is one; of tfds without TensorFlow
_FAILURES += (SyntaxError, tokenize.TokenError)  # of NumPy, which parses a file's header
_FAILURES += (zipfile.BadZipFile, zlib.error, struct.error)
_KINDS = ((stat.S_ISDIR, "a folder"), (stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket"))


class RefusedError(ValueError):
    """A file or a name that is not trusted; the message is a whole sentence."""


def inside(folder: Path, name: object) -> Path:
    """The path in a folder that a name of others stands for, by the name alone.

    Raises:
        RefusedError: the name is no relative path that stays in the folder.
    """
    if not isinstance(name, str) or not name or "\0" in name:
        raise RefusedError(f"{folder} names a file {name!r}, which is no name of a file")
    if _URL.match(name) or os.path.isabs(name) or ".." in re.split(r"[/\\]", name):
        raise RefusedError(
            f"{folder} names a file {name!r}: names must be relative and stay in the folder"
        )
    return folder / name


def check_local(path: Path) -> None:
    """Raise ValueError for a URL: what is written goes to this machine."""
    if len(path.parts) > 1 and _URL.fullmatch(path.parts[0]):
        raise ValueError(f"{path} is a URL: what is written goes to a folder of this machine")


def regular(path: Path, folder: Path | None = None) -> Path:
    """The same path, if a file is there that has an end and can be read.

    Args:
        path: may be a link.
        folder: where the file must lie, links followed; None: anywhere. Of a snapshot in the cache
            of Hugging Face's hub the files are links to where the cache keeps them.

    Raises:
        RefusedError: it is no regular file, or lies outside of the folder.
        OSError: there is none, or it must not be read.
    """
    real = Path(os.path.realpath(path, strict=True))
    mode = real.stat().st_mode
    if not stat.S_ISREG(mode):
        kind = next((name for test, name in _KINDS if test(mode)), "a device")
        raise RefusedError(f"{path} must be a file, but is {kind}")
    _check_place(path, folder)
    if not os.access(real, os.R_OK):
        raise PermissionError(13, os.strerror(13), str(path))
    return path


def beside(file: Path, name: object) -> Path:
    """The path of a file that another one names, which lies beside it or is missing.

    Raises:
        RefusedError: the name leads elsewhere, or to something that is no file.
        OSError: it must not be read.
    """
    if not isinstance(name, str) or Path(name).name != name or name in ("", "..") or "\0" in name:
        raise RefusedError(f"{file} names {name!r}, which is no file beside it")
    path = file.parent / name
    return regular(path) if path.exists() else path


def check_only_files(folder: Path, home: Path | None = None) -> None:
    """Raise unless there are but files and folders in a folder: who reads a pipe waits for ever.

    Args:
        folder: in which to look.
        home: where all must lie, links followed; None: anywhere.

    Raises:
        RefusedError: there is something else, or it lies elsewhere.
        OSError: a link leads to nothing, or a file must not be read.
    """
    for path in folder.rglob("*"):
        if path.is_dir():
            _check_place(path, home)
        else:
            regular(path, home)


def read_bytes(path: Path, folder: Path | None = None) -> bytes:
    """What is in a file that `regular` lets pass.

    Raises:
        RefusedError: as `regular`; or it is larger than `TEXT_BYTES`.
        OSError: as `regular`.
    """
    if (size := regular(path, folder).stat().st_size) > TEXT_BYTES:
        raise RefusedError(f"{path} has {size} bytes; it may have {TEXT_BYTES}")
    return path.read_bytes()


def read_text(path: Path, folder: Path | None = None) -> str:
    """The text of a file, see `read_bytes`.

    Raises:
        RefusedError: as `read_bytes`.
        OSError: as `regular`.
        ValueError: it is no UTF-8.
    """
    return read_bytes(path, folder).decode()


def read_json(path: Path, folder: Path | None = None) -> Any:
    """The JSON value in a file, see `read_text`.

    Raises:
        RefusedError: as `read_text`.
        OSError: as `regular`.
        ValueError: it is no JSON, nested too deeply, or has half a character in a text.
    """
    try:
        value = json.loads(read_text(path, folder))
        json.dumps(value, ensure_ascii=False).encode()  # raises where a text is no Unicode
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    return value


@contextlib.contextmanager
def damage(path: Path, *also: type[Exception], remedy: str = "") -> Iterator[None]:
    """What goes wrong inside becomes one ValueError about this path; a refusal is one already.

    Args:
        path: the file or folder that is read inside.
        also: what a library raises of damage, beside Python's own exceptions.
        remedy: what may be done, at the end of the sentence.
    """
    try:
        yield
    except RefusedError:
        raise
    except (*_FAILURES, *also) as error:
        if isinstance(error, FileNotFoundError) and error.filename:
            raise ValueError(f"{os.fsdecode(error.filename)} is missing{remedy}") from error
        what = f"lacks {error}" if isinstance(error, KeyError) else f"is damaged ({reason(error)})"
        raise ValueError(f"{path} {what}{remedy}") from error


def reason(error: BaseException) -> str:
    """What a library says of an error, which can be long; its beginning says what is wrong."""
    text = str(getattr(error, "strerror", None) or error) or type(error).__name__
    return text.partition("\n")[0].rstrip(".")[:200]


def check_memory(size: int, what: object) -> None:
    """Raise RefusedError if so many bytes are more than this machine's memory has in all."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if size > memory:
        raise RefusedError(
            f"{what} would take {size / 2**30:.3g} GiB of memory, of which there are "
            f"{memory / 2**30:.3g}"
        )


def whole(number: Any) -> int:
    """A number of a table as an integer: tables with gaps hold integers as floats.

    Raises:
        ValueError: it is none, or not below 2^63.
    """
    is_number = isinstance(number, int | float) and not isinstance(number, bool)
    if not is_number or not abs(number) < 2**63 or number != int(number):
        raise ValueError(f"{str(number)[:40]!r} is no whole number")
    return int(number)


def _check_place(path: Path, folder: Path | None) -> None:
    """Raise RefusedError for what lies outside of a folder, links followed."""
    real = Path(os.path.realpath(path))
    if folder is not None and not any(real.is_relative_to(home) for home in _homes(folder)):
        raise RefusedError(f"{path} leads to {real}, out of {folder}: put the file itself there")


def _homes(folder: Path) -> list[Path]:
    """Where the files of a folder may lie.

    The hub's cache is cache/datasets--OWNER--NAME/snapshots/REVISION/, whose files are links into
    the blobs/ of the dataset, and those perhaps into the blobs/ of the cache (huggingface_hub
    2.4.0, file_download.py and utils/_shared_blobs.py).
    """
    folder = Path(os.path.realpath(folder))
    homes = [folder]
    for place in (folder, *folder.parents):
        repository = place.parent.parent
        if place.parent.name == "snapshots" and "--" in repository.name:
            homes += [repository / "blobs", repository.parent / "blobs"]
    return homes
