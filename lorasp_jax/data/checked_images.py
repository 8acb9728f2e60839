"""Memory-mapped images, each verified against its checksum when it is first read."""

import zlib
from pathlib import Path
from typing import Any

import jax
import numpy as np


class CheckedImages:
    """A memory-mapped array of images, uint8 `[N, H, W, 3]`; indexing reads and verifies them.

    Opening does not verify them, because the file may be larger than memory.
    """

    def __init__(self, path: Path, array: np.ndarray, checksums: np.ndarray) -> None:
        """Wrap a memory-mapped array.

        Args:
            path: the file.
            array: the memory-mapped file.
            checksums: uint32 `[N]`, see `checksum`.

        Raises:
            ValueError: the numbers of checksums and images differ.
        """
        if checksums.shape != array.shape[:1]:
            raise ValueError(f"{path} has {len(array)} images but {len(checksums)} checksums")
        self._path, self._array, self._checksums = path, array, checksums
        self._verified = np.zeros(len(array), bool)
        self.shape: tuple[int, ...] = array.shape
        self.dtype: np.dtype[Any] = array.dtype
        self.ndim: int = array.ndim
        self.size: int = array.size
        self.nbytes: int = array.nbytes

    def __len__(self) -> int:
        return len(self._array)

    def __getitem__(self, index: Any) -> np.ndarray:
        """Index as in NumPy.

        Raises:
            ValueError: an image is damaged.
        """
        rows = index[0] if isinstance(index, tuple) else index
        self._verify(np.arange(len(self))[rows] if isinstance(rows, slice) else np.asarray(rows))
        return self._array[index]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """Read all images."""
        return np.array(self[:], dtype, copy=copy)

    def _verify(self, rows: np.ndarray) -> None:
        for row in np.unique(rows[~self._verified[rows]]):
            if checksum(self._array[row]) != self._checksums[row]:
                raise ValueError(f"{self._path} is damaged (wrong checksum of image {row})")
            self._verified[row] = True


def checksum(image: np.ndarray) -> int:
    """Compute the CRC-32 of an image's bytes."""
    return zlib.crc32(np.ascontiguousarray(image).data)


def load_images(tree: Any) -> Any:
    """Read all `CheckedImages` of a pytree into arrays."""
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, CheckedImages) else x, tree)
