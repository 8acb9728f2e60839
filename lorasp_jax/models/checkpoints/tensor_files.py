"""Tensors in safetensors files, one or several with an index as Hugging Face cuts them."""

import json
import math
import re
from collections.abc import Callable, Iterator, MutableMapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors

from envs.datasets.files import beside, check_memory, read_text

SINGLE, INDEX = "model.safetensors", "model.safetensors.index.json"


def weight_files(folder: Path) -> list[Path]:
    """The one safetensors file of a folder, or the shards that its index lists.

    Raises:
        ValueError: the index is damaged, or names files elsewhere.
    """
    index = folder / INDEX
    if not index.exists():
        return [folder / SINGLE]
    try:
        where = json.loads(read_text(index))["weight_map"]
        names = sorted(set(where.values()))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{index} is damaged.") from error
    return [beside(index, name) for name in names]


class TensorFiles(MutableMapping[str, np.ndarray]):
    """Tensors by name, each read when asked for and kept by nobody here.

    Args:
        files: from `weight_files`.
        rename: the name to give a stored one.

    Raises:
        ValueError: a file is missing, damaged or cut short, or a name is there twice.
    """

    def __init__(self, files: list[Path], rename: Callable[[str], str] = str) -> None:
        self._found: dict[str, tuple[Any, str]] = {}
        for path in files:
            try:
                if path.exists() and not path.is_file():
                    raise OSError("it is no file")
                file = safetensors.safe_open(path, framework="np")
            except FileNotFoundError as error:
                raise ValueError(f"{path.parent} lacks {path.name}.") from error
            except (OSError, safetensors.SafetensorError) as error:
                raise ValueError(f"{path} is damaged or cut short.") from error
            for name in file.keys():  # noqa: SIM118, which is no mapping
                short = rename(name)
                if short in self._found:
                    other = self._found[short][1]
                    raise ValueError(f"{path} has one tensor under two names, {other} and {name}.")
                self._found[short] = file, name

    def rename(self, old: str, new: str) -> None:
        """Lets a tensor be found under another name."""
        self._found[new] = self._found.pop(old)

    def __getitem__(self, name: str) -> np.ndarray:
        """The tensor; raises a ValueError for one beyond this machine's memory."""
        file, stored = self._found[name]
        part = file.get_slice(stored)
        bits = re.search(r"\d+", part.get_dtype())  # "BF16", "F8_E4M3", "BOOL"
        check_memory(math.prod(part.get_shape()) * (int(bits[0]) if bits else 8) // 8, name)
        return file.get_tensor(stored)

    def __delitem__(self, name: str) -> None:
        del self._found[name]

    def __setitem__(self, name: str, array: np.ndarray) -> None:
        raise TypeError("files are only read")

    def __iter__(self) -> Iterator[str]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)
