"""Arrays in files that grow."""

import os
from pathlib import Path

import numpy as np


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
        """Ends it; it is on the disk then."""
        self._file.seek(0)
        self._write_header()
        self._file.flush()
        os.fsync(self._file.fileno())  # before the folder gets its name
        self._file.close()

    def _write_header(self) -> None:
        # NumPy leaves room for the first axis to grow.
        header = self._kind | {"shape": (self._length, *self._row)}
        np.lib.format.write_array_header_1_0(self._file, header)
