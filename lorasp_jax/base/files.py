"""Checks of untrusted files: their location, their type and their size.

A name in a dataset or a model may be a URL, lead out of its folder or refer to a pipe. A size
recorded there may exceed any memory. All code that opens such files calls these checks first.
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
"""Size limit of files that are read whole; the text for a million episodes takes a tenth of it."""
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")
_FAILURES = (
    *(OSError, ValueError, LookupError, TypeError, AttributeError, EOFError, ArithmeticError),
    *(RuntimeError, zipfile.BadZipFile, zlib.error, struct.error),
    # Of tfds without TensorFlow, and of NumPy headers.
    *(ImportError, SyntaxError, tokenize.TokenError),
)


class RefusedError(ValueError):
    """A file or a name that is not trusted; the message is a complete sentence."""


def join_inside(folder: Path, name: object) -> Path:
    """Join a folder and an untrusted name, checking only the name.

    Raises:
        RefusedError: the name is not a relative path that stays in the folder.
    """
    text = name if isinstance(name, str) else "\0"
    leaves = _URL.match(text) or os.path.isabs(text) or ".." in re.split(r"[/\\]", text)
    if not text or "\0" in text or leaves:
        raise RefusedError(f"{folder} refers to {name!r}: names must stay in the folder")
    return folder / text


def check_local(path: Path) -> None:
    """Raise ValueError for a URL, since only local files can be written."""
    if len(path.parts) > 1 and _URL.fullmatch(path.parts[0]):
        raise ValueError(f"cannot write to the URL {path}: give a path on this machine")


def check_regular(path: Path, folder: Path | None = None) -> Path:
    """Check that a path is a readable regular file, and return it.

    Args:
        path: the file, or a link to it.
        folder: folder that must contain the file once links are resolved; None: anywhere. If it is
            a snapshot in the Hugging Face cache, links into that cache are allowed.

    Raises:
        RefusedError: it is not a regular file, or is outside of the folder.
        OSError: it is missing or unreadable.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise RefusedError(f"{path} must be a regular file")
    _check_contained(path, folder)
    if not os.access(path, os.R_OK):
        raise PermissionError(13, os.strerror(13), str(path))
    return path


def check_only_files(folder: Path, home: Path | None = None) -> None:
    """Raise unless a folder contains only files and folders: reading a pipe would never return.

    Args:
        folder: the folder, searched recursively.
        home: folder that must contain everything once links are resolved; None: anywhere.

    Raises:
        RefusedError: it contains something else, or leads out of `home`.
        OSError: a link is broken, or a file is unreadable.
    """
    for path in folder.rglob("*"):
        if path.is_dir():
            _check_contained(path, home)
        else:
            check_regular(path, home)


def read_bytes(path: Path, folder: Path | None = None) -> bytes:
    """Read a file of at most `TEXT_BYTES` after the checks of `check_regular`."""
    if (size := check_regular(path, folder).stat().st_size) > TEXT_BYTES:
        raise RefusedError(f"{path} has {size} bytes; at most {TEXT_BYTES} are allowed")
    return path.read_bytes()


def read_text(path: Path, folder: Path | None = None) -> str:
    """Read a UTF-8 file (see `read_bytes`); raise ValueError if it has another encoding.

    A byte order mark, with which some editors begin a file, is skipped.
    """
    return read_bytes(path, folder).decode("utf-8-sig")


def read_json(path: Path, folder: Path | None = None) -> Any:
    """Read a JSON file (see `read_bytes` and `parse_json`)."""
    return parse_json(read_text(path, folder))


def parse_json(text: str) -> Any:
    """Parse JSON.

    Raises:
        ValueError: it is not JSON, has a string with a lone surrogate or a key twice.
        RecursionError: it is nested too deeply.
    """
    value = json.loads(text, object_pairs_hook=_unique)
    json.dumps(value, ensure_ascii=False).encode()  # raises for lone surrogates
    return value


def read_json_lines(path: Path, folder: Path | None = None) -> list[dict[str, Any]]:
    """Read a file of one JSON object a line (see `read_bytes` and `parse_json`).

    Only a line feed ends a line: JSON strings may contain the other line ends of Unicode.
    """
    rows = [parse_json(line) for line in read_text(path, folder).split("\n") if line.strip()]
    if wrong := [row for row in rows if not isinstance(row, dict)]:
        raise ValueError(f"each line must be an object, got {str(wrong[0])[:40]!r}")
    return rows


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Build a JSON object, whose last value would otherwise win if a key appears twice."""
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"it has the key {max(keys, key=keys.count)!r} twice")
    return found


@contextlib.contextmanager
def as_value_error(
    path: Path, *also: type[Exception], remedy: str = "", problem: str = "is damaged"
) -> Iterator[None]:
    """Convert read errors to a ValueError that names the path; a RefusedError passes unchanged.

    Args:
        path: the file or folder read in the block.
        also: further exceptions that a library raises for damaged files.
        remedy: what to do, as the end of the message.
        problem: what the file is if it cannot be read; people also write files themselves.
    """
    try:
        yield
    except RefusedError:
        raise
    except (*_FAILURES, *also) as error:
        if isinstance(error, FileNotFoundError) and error.filename:
            raise ValueError(f"{os.fsdecode(error.filename)} is missing{remedy}") from error
        cause = first_line(error)
        problem = f"lacks {error}" if isinstance(error, KeyError) else f"{problem} ({cause})"
        raise ValueError(f"{path} {problem}{remedy}") from error


def first_line(error: BaseException) -> str:
    """Return the first line of an error message, at most 200 characters."""
    text = str(getattr(error, "strerror", None) or error) or type(error).__name__
    return text.partition("\n")[0].rstrip(".")[:200]


def check_memory(size: int, what: object) -> None:
    """Raise RefusedError if `size` bytes exceed the total memory of this machine."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if size > memory:
        gib, total = size / 2**30, memory / 2**30
        raise RefusedError(f"{what} would take {gib:.3g} GiB of memory; there are {total:.3g} GiB")


def as_int(number: Any) -> int:
    """Convert a number from a table to an int; it is a float if its column has missing values.

    Raises:
        ValueError: it is not an integer, or its magnitude is 2^63 or more.
    """
    is_number = isinstance(number, int | float) and not isinstance(number, bool)
    if not is_number or not abs(number) < 2**63 or number != int(number):
        raise ValueError(f"{str(number)[:40]!r} is not an integer")
    return int(number)


def _check_contained(path: Path, folder: Path | None) -> None:
    """Raise RefusedError if a path is outside of a folder once links are resolved."""
    real = Path(os.path.realpath(path))
    if folder is not None and not any(real.is_relative_to(f) for f in _allowed_folders(folder)):
        raise RefusedError(f"{path} links to {real}, outside of {folder}")


def _allowed_folders(folder: Path) -> list[Path]:
    """Return the folders in which the files of a folder may be stored.

    In the Hugging Face cache, the files of a snapshot, datasets--OWNER--NAME/snapshots/REVISION/,
    are links into the dataset's blobs/. The files there may be links into the cache's own blobs/
    (huggingface_hub 2.4.0, file_download.py and utils/_shared_blobs.py).
    """
    folder = Path(os.path.realpath(folder))
    allowed = [folder]
    for path in (folder, *folder.parents):
        repository = path.parent.parent
        if path.parent.name == "snapshots" and "--" in repository.name:
            allowed += [repository / "blobs", repository.parent / "blobs"]
    return allowed
