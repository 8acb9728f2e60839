"""Arrays in files: written row by row, and mapped into memory again."""

import zlib
from pathlib import Path
from typing import Any

import numpy as np

from envs.datasets.files import damage, regular


class Column:
    """An .npy file that grows along the first axis."""

    def __init__(self, path: Path, like: np.ndarray) -> None:
        """Begins an empty one whose rows are as those of an array."""
        self._file = path.open("wb")
        self._kind = {"descr": np.lib.format.dtype_to_descr(like.dtype), "fortran_order": False}
        self._row, self._length = like.shape[1:], 0
        self._write_header()

    def append(self, rows: np.ndarray) -> None:
        """Adds rows."""
        rows = np.ascontiguousarray(rows)
        self._file.write(rows.data)
        self._length += len(rows)

    def close(self) -> None:
        """Ends it."""
        self._file.seek(0)
        self._write_header()
        self._file.close()

    def _write_header(self) -> None:
        # NumPy leaves room for the first axis to grow.
        header = self._kind | {"shape": (self._length, *self._row)}
        np.lib.format.write_array_header_1_0(self._file, header)


def mapped(
    path: Path, kind: Any, shape: tuple[int | None, ...], crc32: int | None = None
) -> np.ndarray:
    """The array in a file, which nothing has read where there is no checksum.

    Args:
        path: of the .npy file.
        kind: the type it must have.
        shape: likewise, where it is given.
        crc32: of its bytes in memory, if it is known.

    Raises:
        ValueError: it is missing or damaged.
    """
    with damage(path):
        array: Any = np.load(regular(path, path.parent), mmap_mode="r")
        wanted = tuple(n if n else m for n, m in zip(shape, array.shape, strict=True))
        if array.shape != wanted or array.dtype != np.dtype(kind) or not array.flags.c_contiguous:
            order = "" if array.flags.c_contiguous else ", column by column"
            raise ValueError(
                f"it is {array.dtype.str} {array.shape}{order}, not {np.dtype(kind).str} {wanted}"
            )
        if path.stat().st_size != array.offset + array.nbytes:
            raise ValueError(f"it holds other bytes than those of {wanted}")
        if crc32 is not None and zlib.crc32(array.data) != crc32:
            raise ValueError("its checksum is another one")
        return array.view(np.ndarray)
