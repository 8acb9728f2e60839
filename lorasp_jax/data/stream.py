"""Windows from a cache in endless, shuffled order, by Grain; the position is one integer.

    for raw in Stream(Cache("my_cache").steps, batch_size=32, chunk=50, seed=0, start=1000):

A batch is a function of seed and position alone. All processes together see the same batches, row
for row, however many they are, so a run may go on with another number of them.
"""

from typing import Any

import grain
import numpy as np

from lorasp_jax.data.batches import Raw, Steps, gather

_THREADS, _AHEAD = 1, 4  # that gather batches (a second one waits for Python); batches ready


class Stream:
    """An endless iterator of `Raw` batches in host memory.

    Attributes:
        position: batches given so far, counted from the very beginning.
    """

    def __init__(
        self,
        steps: Steps,
        *,
        batch_size: int,
        chunk: int,
        seed: int,
        start: int = 0,
        process: tuple[int, int] = (0, 1),
    ) -> None:
        """Begins to read ahead in threads.

        Args:
            steps: as `Cache.steps` has them.
            batch_size: windows in a batch, over all processes.
            chunk: C, actions in a window.
            seed: of the order; every epoch has another one.
            start: `position` to go on from.
            process: index of this process and their number; each gets its share of a batch.

        Raises:
            ValueError: the processes cannot share a batch evenly, or another number is impossible.
        """
        index, count = process
        if batch_size < 1 or chunk < 1 or start < 0 or batch_size % count:
            raise ValueError(
                f"batch_size must be a multiple of the {count} processes, chunk at least 1 and "
                f"start at least 0; got {batch_size}, {chunk} and {start}"
            )
        self.position: int = start

        share = batch_size // count
        rows = slice(index * share, (index + 1) * share)

        def read(start: np.ndarray) -> Raw:
            return gather(steps, start[rows], chunk)

        order: Any = grain.MapDataset.range(len(steps.end)).seed(seed).shuffle().repeat()
        batches = order.batch(batch_size).map(read)
        ahead = grain.ReadOptions(num_threads=_THREADS, prefetch_buffer_size=_AHEAD)
        self._iterator: Any = iter(batches.to_iter_dataset(ahead))
        self._iterator.set_state({"next_index": start})

    def __iter__(self) -> "Stream":
        """Itself."""
        return self

    def __next__(self) -> Raw:
        """The batch at `position`."""
        raw = next(self._iterator)
        self.position += 1
        return raw
