"""Columns of a cache: .npy files, written row by row and memory-mapped."""

import zlib
from pathlib import Path
from typing import Any

import numpy as np

from lorasp_jax.base.files import as_value_error, check_regular


class Column:
    """An .npy file that grows along its first axis; `crc32` is the checksum of its rows."""

    def __init__(self, path: Path, like: np.ndarray) -> None:
        """Create an empty file for rows of the same dtype and shape as those of `like`."""
        self._path = path
        self._header = {"descr": np.lib.format.dtype_to_descr(like.dtype), "fortran_order": False}
        self._row_shape, self._length, self.crc32 = like.shape[1:], 0, 0
        self._write_header("wb")

    def append(self, rows: np.ndarray) -> None:
        """Append rows."""
        rows = np.ascontiguousarray(rows)
        with self._path.open("ab") as file:
            file.write(rows.data)
        self.crc32 = zlib.crc32(rows.data, self.crc32)
        self._length += len(rows)

    def complete(self) -> None:
        """Write the final length."""
        self._write_header("r+b")

    def _write_header(self, mode: str) -> None:
        # NumPy pads the header so that the first dimension can grow in place.
        header = self._header | {"shape": (self._length, *self._row_shape)}
        with self._path.open(mode) as file:
            np.lib.format.write_array_header_1_0(file, header)


def map_column(path: Path, dtype: Any, expected: int | tuple[int, ...]) -> np.ndarray:
    """Memory-map the array of a .npy file.

    `expected` is the checksum of its bytes, for which all are read, or its shape.

    Raises:
        ValueError: the file is missing or damaged.
    """
    with as_value_error(path):
        array: Any = np.load(check_regular(path, path.parent), mmap_mode="r")
        if not array.flags.c_contiguous:
            raise ValueError("it is in Fortran order")
        found = array.shape if isinstance(expected, tuple) else zlib.crc32(array.data)
        if array.dtype != np.dtype(dtype) or found != expected:
            raise ValueError("its type, shape or checksum does not match")
    return array.view(np.ndarray)
