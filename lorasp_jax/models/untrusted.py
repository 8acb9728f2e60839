"""Files beside a model, which others wrote: nothing that they name or claim is trusted.

`envs.files` does the same for datasets; a model is loaded without a simulator.
"""

from pathlib import Path
from typing import Any

TEXT_BYTES = 2**30
"""Largest file of text that is read."""


def beside(file: Path, name: Any) -> Path:
    """The path of a file that another one names, which must lie beside it.

    Raises:
        ValueError: the name leads elsewhere, or to something that is no file.
    """
    path = file.parent / str(name)
    if Path(str(name)).name != name or (path.exists() and not path.is_file()):
        raise ValueError(f"{file} names {name!r}, which is no file beside it.")
    return path


def read_text(path: Path) -> str:
    """The text of a file.

    Raises:
        FileNotFoundError: there is none.
        OSError: it must not be read.
        ValueError: it is a pipe or the like, too large, or no UTF-8.
    """
    return read_bytes(path).decode()


def read_bytes(path: Path) -> bytes:
    """What is in a file of text.

    Raises:
        FileNotFoundError: there is none.
        OSError: it must not be read.
        ValueError: it is a pipe or the like, or too large.
    """
    if path.exists() and not path.is_file():
        raise ValueError("it is no file")
    if path.stat().st_size > TEXT_BYTES:
        raise ValueError(f"it has more than {TEXT_BYTES} bytes")
    return path.read_bytes()


def check_only_files(folder: Path) -> None:
    """Raise ValueError for a pipe or the like anywhere in a folder: whoever reads it may wait for
    ever.
    """
    for path in folder.rglob("*"):
        if not (path.is_dir() or path.is_file()):
            raise ValueError(f"{path} is no file")
