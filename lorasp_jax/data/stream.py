"""Stream shuffled batches of windows from a cache, endlessly, with Grain.

    for raw in Stream(Cache("my_cache").steps, batch_size=32, chunk=50, seed=0, start=1000):

For given data and batch size, a global batch depends only on the seed and its position. A run can
therefore resume at any position, and with a different number of processes.
"""

import itertools
from typing import Any

import grain
import numpy as np

from lorasp_jax.data.batches import RawBatch, Steps, gather

_THREADS = 1  # a second thread would only wait for the GIL
_PREFETCH = 4  # batches


class Stream:
    """An endless iterator of `RawBatch` batches in host memory."""

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
        """Create a stream that prefetches in a background thread.

        Args:
            steps: steps to sample from, see `Cache.steps`.
            batch_size: number of windows in a batch, over all processes; a multiple of their
                number.
            chunk: C, the number of actions in a window.
            seed: seed of the shuffling; every epoch has a different order.
            start: index of the first batch, counted from the start of training.
            process: index of this process, and number of processes; each gets an equal share of a
                batch.
        """
        index, count = process
        share = batch_size // count
        rows = slice(index * share, (index + 1) * share)

        def read(window: np.ndarray) -> RawBatch:
            return gather(steps, steps.start(window[rows]), chunk)

        batches = _order(steps, seed).batch(batch_size).map(read)
        options = grain.ReadOptions(num_threads=_THREADS, prefetch_buffer_size=_PREFETCH)
        self._iterator: Any = iter(batches.to_iter_dataset(options))
        self._iterator.set_state({"next_index": start})

    def __iter__(self) -> "Stream":
        return self

    def __next__(self) -> RawBatch:
        """Return the next batch."""
        return next(self._iterator)


def _order(steps: Steps, seed: int) -> Any:
    """Return the endless order of windows: all of them in each epoch, of each dataset if weighted.

    The datasets of a mixture take turns. Their shares are rounded to hundredths of the least, so
    that none changes by more than 1 % of itself.
    """

    def shuffled(low: int, high: int, seed: int) -> Any:
        return grain.MapDataset.range(low, high).seed(seed).shuffle().repeat()

    if steps.mixture is None:
        return shuffled(0, steps.num_starts, seed)
    bounds, shares = (np.asarray(array).tolist() for array in steps.mixture)
    pairs = [*itertools.pairwise(bounds)]
    used = [i for i, share in enumerate(shares) if share]
    datasets = [shuffled(*pairs[i], seed + i) for i in used]
    weights = [round(100 * shares[i] / min(shares[j] for j in used)) for i in used]
    return grain.MapDataset.mix(datasets, weights)
