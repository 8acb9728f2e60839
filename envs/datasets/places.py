"""Where a collection ends up: the old goes when the new is whole."""

import os
import shutil
from pathlib import Path

from envs.datasets import rlds


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
