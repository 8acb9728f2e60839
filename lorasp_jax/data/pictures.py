"""Pictures in a file, each compared with its checksum when it is first read."""

import zlib
from pathlib import Path
from typing import Any

import jax
import numpy as np


class Pictures:
    """An array of pictures in a file, uint8 `[N, H, W, 3]`; indexing reads them.

    A file may be larger than any memory, so that its bytes are looked at when they are wanted.
    """

    def __init__(self, path: Path, array: np.ndarray, checksums: np.ndarray) -> None:
        """Reads nothing.

        Args:
            path: of the file.
            array: the file, mapped into memory.
            checksums: uint32 `[N]`, see `checksum`.

        Raises:
            ValueError: there are more or fewer checksums than pictures.
        """
        if checksums.shape != array.shape[:1]:
            raise ValueError(f"{path} has {len(array)} pictures and {len(checksums)} checksums")
        self._path, self._array, self._checksums = path, array, checksums
        self._seen = np.zeros(len(array), bool)
        self.shape: tuple[int, ...] = array.shape
        self.dtype: np.dtype[Any] = array.dtype
        self.ndim: int = array.ndim
        self.size: int = array.size
        self.nbytes: int = array.nbytes

    def __len__(self) -> int:
        """N."""
        return len(self._array)

    def __getitem__(self, index: Any) -> np.ndarray:
        """What NumPy gives.

        Raises:
            ValueError: a picture is damaged.
        """
        rows = index[0] if isinstance(index, tuple) else index
        self._check(np.arange(len(self))[rows] if isinstance(rows, slice) else np.asarray(rows))
        return self._array[index]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """All of them."""
        return np.array(self[:], dtype, copy=copy)

    def _check(self, rows: np.ndarray) -> None:
        for row in np.unique(rows[~self._seen[rows]]):
            if checksum(self._array[row]) != self._checksums[row]:
                raise ValueError(f"{self._path} is damaged (picture {row} has another checksum)")
            self._seen[row] = True


def checksum(picture: np.ndarray) -> int:
    """CRC-32 of a picture's bytes."""
    return zlib.crc32(np.ascontiguousarray(picture).data)


def loaded(tree: Any) -> Any:
    """A tree whose pictures are arrays, all of them read."""
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, Pictures) else x, tree)
