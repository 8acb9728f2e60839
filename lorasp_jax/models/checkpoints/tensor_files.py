"""Lazy access to safetensors: a single file, or shards with Hugging Face's index."""

import math
import re
from collections.abc import Callable, Iterator, MutableMapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors

from lorasp_jax.base import json_values
from lorasp_jax.base.files import (
    as_value_error,
    check_memory,
    check_regular,
    join_inside,
    read_json,
)

SINGLE, INDEX = "model.safetensors", "model.safetensors.index.json"


def weight_files(folder: Path) -> list[Path]:
    """List a folder's single safetensors file or, without one, the shards in its index.

    Transformers prefers the single file (modeling_utils.py), and LeRobot reads nothing else
    (policies/pretrained.py).

    Raises:
        ValueError: the index is damaged or names files outside the folder.
    """
    index = folder / INDEX
    if (folder / SINGLE).exists() or not index.exists():
        return [folder / SINGLE]
    with as_value_error(index):
        json_values.check(content := read_json(index), {"weight_map": {str: str}})
    names = sorted(set(content["weight_map"].values()))
    return [join_inside(folder, name) for name in names]


class TensorFiles(MutableMapping[str, np.ndarray]):
    """Mapping from names to tensors. Each access reads from the file; nothing is cached.

    Args:
        files: from `weight_files`.
        rename: stored name -> name in this mapping.

    Raises:
        ValueError: a file is missing, damaged or truncated, or `rename` maps two tensors to
            one name.
    """

    def __init__(self, files: list[Path], rename: Callable[[str], str] = str) -> None:
        self._tensors: dict[str, tuple[Any, str, Path]] = {}
        for path in files:
            with as_value_error(path, safetensors.SafetensorError):
                file = safetensors.safe_open(check_regular(path), framework="np")
                for stored in file.keys():  # noqa: SIM118, safe_open is not iterable
                    if (name := rename(stored)) in self._tensors:
                        raise ValueError(f"it has {name} twice, also as {stored}")
                    self._tensors[name] = file, stored, path

    def rename(self, old: str, new: str) -> None:
        """Rename a tensor in this mapping; the file stays unchanged."""
        self._tensors[new] = self._tensors.pop(old)

    def __getitem__(self, name: str) -> np.ndarray:
        """Read a tensor; raise ValueError if it is float8 or larger than this machine's memory."""
        file, stored, path = self._tensors[name]
        tensor = file.get_slice(stored)
        bits = re.search(r"\d+", tensor.get_dtype())  # "BF16", "F8_E4M3", "BOOL"
        check_memory(math.prod(tensor.get_shape()) * (int(bits[0]) if bits else 8) // 8, name)
        if tensor.get_dtype().startswith("F8"):
            dtype = tensor.get_dtype()
            raise ValueError(f"{name} in {path} is in {dtype}: convert it to bf16 or float32")
        return file.get_tensor(stored)

    def __delitem__(self, name: str) -> None:
        del self._tensors[name]

    def __setitem__(self, name: str, array: np.ndarray) -> None:
        raise TypeError("TensorFiles is read-only")

    def __iter__(self) -> Iterator[str]:
        return iter(self._tensors)

    def __len__(self) -> int:
        return len(self._tensors)
