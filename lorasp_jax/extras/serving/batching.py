"""Run requests of several clients as one batch, in a thread of its own.

The event loop stays free while a policy infers, so `/healthz` always answers. Batches have a few
fixed sizes, compiled in advance; missing rows are copies of the first.

A lone request never waits. After a batch, the worker waits until the clients of that batch have
sent their next requests, at most `WAIT` seconds: clients that ask again at once, each as fast as it
can, so share batches instead of taking turns. Every adapter has its own batches.
"""

import asyncio
import contextlib
import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Future, InvalidStateError
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from lorasp_jax.extras.serving.metrics import Histogram

if TYPE_CHECKING:  # which imports JAX
    from lorasp_jax.extras.serving.served import ServedPolicies

WAIT = 0.003
"""Longest time to wait for the clients of the previous batch [s]."""
HUNG = 10.0
"""Time after which a policy that has not answered counts as hung [s]; clients wait as long."""
_log = logging.getLogger(__name__)


class PolicyFailure(RuntimeError):
    """The policy could not answer; the message is for the client."""


@dataclass(eq=False)
class _Job:
    client: int
    adapter: Any
    row: Any
    future: Future[tuple[np.ndarray, float, float | None]] = field(default_factory=Future)

    def fail(self, sentence: str) -> None:
        with contextlib.suppress(InvalidStateError):  # the other thread was faster
            self.future.set_exception(PolicyFailure(sentence))

    def answer(self, chunk: np.ndarray, milliseconds: float, rank: float | None) -> None:
        with contextlib.suppress(InvalidStateError):  # `close` has given it up
            self.future.set_result((chunk, milliseconds, rank))


class Batcher:
    """Collects rows and runs them in batches, in its own thread until `close`.

    Attributes:
        seconds: how long batches took.
    """

    def __init__(self, policy: "ServedPolicies", counts: Counter[str]) -> None:
        """Start the thread.

        Args:
            policy: runs the batches; its `run` is only called from the thread.
            counts: receives the numbers of batches and of their requests.
        """
        self._policy, self._counts = policy, counts
        self.seconds: Histogram = Histogram()
        self._queue: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._pending: list[_Job] = []
        self._awaited: set[int] = set()
        self._finished, self._begun = 0.0, 0.0
        self._running: list[_Job] = []
        self._closing = self._failed = False
        self._last = ""  # name of the previous adapter, which itself would be kept in memory
        self._thread = threading.Thread(target=self._work, name="policy", daemon=True)
        self._thread.start()

    async def infer(
        self, client: int, adapter: Any, row: Any
    ) -> tuple[np.ndarray, float, float | None]:
        """Run one row, in a batch with others.

        Returns:
            actions f32 `[C, J+1]`, the time that the policy took for the batch [ms], and the row's
            mean active rank if the adapter has an energy gate.

        Raises:
            PolicyFailure: the policy failed, returned values that are not finite, or will not
                answer, as the server closes.
        """
        if self._closing:
            raise PolicyFailure("the server is closing")
        job = _Job(client, adapter, row)
        self._queue.put(job)
        return await asyncio.wrap_future(job.future)

    def problem(self) -> str | None:
        """Say why the policy does not answer; None if it does, or has nothing to answer."""
        running = self._running  # first: a batch may begin in between
        seconds = time.monotonic() - self._begun
        if running and seconds > HUNG:
            return f"the policy has not answered for {seconds:.0f} s"
        if not self._thread.is_alive():
            return "the policy's thread has ended"
        return "the policy failed when it was last asked" if self._failed else None

    def load(self) -> tuple[int, int]:
        """Return how many requests wait, and how many run."""
        return self._queue.qsize() + len(self._pending), len(self._running)

    def close(self, timeout: float | None = None) -> bool:
        """Stop the thread after the current batch; return False if that takes longer [s]."""
        self._closing = True
        self._queue.put(None)
        self._thread.join(timeout)
        hung = self._thread.is_alive()
        for job in self._running if hung else ():
            job.fail("the policy does not answer")
        self._cancel()
        return not hung

    def _cancel(self) -> None:
        """Cancel what has not begun."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._pending += filter(None, [self._queue.get_nowait()])
        for job in self._pending:
            job.future.cancel()

    def _work(self) -> None:
        while self._collect():
            self._answer(self._take_batch())

    def _answer(self, batch: list[_Job]) -> None:
        """Run a batch, unless all of its clients have gone."""
        if batch:
            self._begun, self._running = time.monotonic(), batch
            self._run(batch)
            self._running = []
            self._awaited = {job.client for job in batch}
            self._last = str(batch[0].adapter)
            self._finished = time.monotonic()

    def _collect(self) -> bool:
        """Fill the pending jobs, at least with one; return False after `close`."""
        while True:
            wait = self._seconds_to_wait()
            try:
                job = self._queue.get(timeout=wait) if wait != 0 else self._queue.get_nowait()
            except queue.Empty:
                return True
            if job is None:
                return False
            self._pending.append(job)
            self._awaited.discard(job.client)

    def _seconds_to_wait(self) -> float | None:
        """Return how long to wait for a further job; None: as long as it takes."""
        if not self._pending:
            return None
        other = str(self._pending[0].adapter) != self._last  # which no awaited request can join
        if other or not self._awaited or len(self._pending) >= self._policy.sizes[-1]:
            return 0
        return max(0.0, self._finished + WAIT - time.monotonic())

    def _take_batch(self) -> list[_Job]:
        """Take the oldest job and others with its adapter, skipping clients that have gone."""
        alive = [job for job in self._pending if not job.future.cancelled()]
        chosen = [job for job in alive if job.adapter == alive[0].adapter]
        batch = chosen[: self._policy.sizes[-1]]
        self._pending = [job for job in alive if job not in batch]
        return [job for job in batch if job.future.set_running_or_notify_cancel()]

    def _run(self, batch: list[_Job]) -> None:
        adapter, rows = batch[0].adapter, padded([job.row for job in batch], self._policy.sizes)
        start = time.perf_counter()
        try:
            actions, ranks = self._policy.run(adapter, rows)
            self._failed = False
        except Exception:  # a failed batch must not stop the server
            self._failed = True
            _log.exception("the policy failed")
            for job in batch:
                job.fail("the policy failed: see the server's log")
            return
        milliseconds = (time.perf_counter() - start) * 1e3
        self.seconds.observe(str(adapter), milliseconds / 1e3)
        self._counts["batches"] += 1
        self._counts["batched_requests"] += len(batch)
        for number, (job, chunk) in enumerate(zip(batch, actions, strict=False)):
            if np.isfinite(chunk).all():
                job.answer(chunk, milliseconds, None if ranks is None else float(ranks[number]))
            else:
                job.fail("the policy returned actions that are not finite")


def padded(rows: list[Any], sizes: Sequence[int]) -> list[Any]:
    """Append copies of the first row up to the next of the ascending batch sizes."""
    size = next(size for size in sizes if size >= len(rows))
    return rows + rows[:1] * (size - len(rows))
