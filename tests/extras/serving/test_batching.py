"""Test how requests of several clients become batches."""

import asyncio
import threading
import time
import weakref
from collections import Counter

import numpy as np
import pytest

from lorasp_jax.extras.serving import batching
from lorasp_jax.extras.serving.batching import Batcher, PolicyFailure
from tests.extras.serving.stand_in import SPEC, StandIn


class Clients:
    """Runs requests of several clients against a batcher."""

    def __init__(self, policy):
        self.policy, self.counts = policy, Counter()
        self.batcher = Batcher(policy, self.counts)

    async def ask(self, client, adapter="base"):
        row = np.full(SPEC.state_dim, client, np.float32)
        actions, *_ = await self.batcher.infer(client, adapter, row)
        return float(actions[0, 0])

    async def queue(self, *requests):
        """Ask; return the tasks once the first has reached the policy and the others wait."""
        self.policy.gate.clear()
        tasks = [asyncio.create_task(self.ask(*requests[0]))]
        await until(lambda: self.policy.batches)
        for number, request in enumerate(requests[1:], start=1):
            tasks.append(asyncio.create_task(self.ask(*request)))
            await until(lambda n=number: self.batcher._queue.qsize() == n)
        return tasks

    async def gather(self, *requests):
        """Return the results of `queue`."""
        tasks = await self.queue(*requests)
        self.policy.gate.set()
        return await asyncio.gather(*tasks, return_exceptions=True)

    def run(self, coroutine):
        try:
            return asyncio.run(coroutine)
        finally:
            self.policy.gate.set()
            self.batcher.close()


async def until(condition):
    while not condition():
        await asyncio.sleep(0.001)


def test_requests_that_wait_share_a_batch_of_a_compiled_size():
    clients = Clients(StandIn())
    assert clients.run(clients.gather(*([i] for i in range(12)))) == list(range(12))
    assert clients.policy.batches == [("base", 1), ("base", 8), ("base", 4)]
    assert clients.counts == {"batched_requests": 12, "batches": 3}


def test_every_adapter_has_its_own_batches_in_order_of_arrival():
    clients = Clients(StandIn(adapters=("base", "a", "b")))
    asked = enumerate(["base", "a", "b", "a", "b"])
    assert clients.run(clients.gather(*asked)) == [0, 1001, 2002, 1003, 2004]
    assert clients.policy.batches == [("base", 1), ("a", 2), ("b", 2)]


def test_an_adapter_of_the_last_batch_is_not_kept():
    """One that was unloaded leaves memory even if nobody asks again."""

    class Adapter(str):
        __slots__ = ("__weakref__",)

    clients, kept = Clients(StandIn()), []

    async def work():
        adapter = Adapter("base")
        kept.append(weakref.ref(adapter))
        await clients.ask(0, adapter)
        del adapter
        await until(lambda: not clients.batcher._running)
        await asyncio.sleep(0.1)
        return kept[0]()

    assert clients.run(work()) is None


def test_a_lone_client_never_waits(monkeypatch):
    monkeypatch.setattr(batching, "WAIT", 60)
    clients = Clients(StandIn())

    async def work():
        return [await clients.ask(0) for _ in range(20)]

    start = time.perf_counter()
    clients.run(work())
    assert time.perf_counter() - start < 30


def test_clients_that_ask_again_at_once_share_every_batch(monkeypatch):
    """Without waiting, they would take turns: one in a batch, the others in the next."""
    monkeypatch.setattr(batching, "WAIT", 1)  # on a busy machine, clients need more than 3 ms
    clients = Clients(StandIn(seconds=0.005))

    async def client(number):
        for _ in range(30):
            await clients.ask(number)

    async def work():
        await asyncio.gather(*(client(i) for i in range(8)))

    clients.run(work())
    assert clients.counts["batched_requests"] == 240
    assert clients.counts["batches"] <= 40


def test_a_client_that_does_not_come_back_delays_others_briefly():
    clients = Clients(StandIn())

    async def work():
        await clients.ask(0)
        start = time.perf_counter()
        await clients.ask(1)
        return time.perf_counter() - start

    assert clients.run(work()) < batching.WAIT + 5  # s; a busy machine may switch threads late


def test_a_failure_reaches_every_client_of_the_batch_and_the_log(caplog):
    clients = Clients(StandIn())

    async def work():
        tasks = await clients.queue([0], [1], [2])
        clients.policy.failure = RuntimeError("out of memory")
        clients.policy.gate.set()
        failures = await asyncio.gather(*tasks, return_exceptions=True)
        clients.policy.failure = None
        return failures, await clients.ask(1)

    failures, later = clients.run(work())
    assert [type(each) for each in failures] == [PolicyFailure] * 3
    assert "out of memory" not in str(failures)
    assert later == 1
    assert caplog.text.count("RuntimeError: out of memory") == 2  # of two batches


def test_rows_of_clients_that_have_gone_are_not_run():
    clients = Clients(StandIn())

    async def work():
        first, gone = await clients.queue([0], [1])
        gone.cancel()
        await asyncio.sleep(0.01)
        clients.policy.gate.set()
        await first
        return await clients.ask(2)

    assert clients.run(work()) == 2
    assert clients.policy.batches == [("base", 1), ("base", 1)]


def test_one_bad_row_does_not_spoil_the_others():
    clients = Clients(StandIn())
    *good, bad = clients.run(clients.gather([0], [1], [3], [np.nan]))
    assert good == [0, 1, 3]
    assert isinstance(bad, PolicyFailure)


def test_closing_cancels_what_waits():
    clients = Clients(StandIn())

    async def work():
        first, second = await clients.queue([0], [1])
        closing = threading.Thread(target=clients.batcher.close)
        closing.start()
        await until(lambda: clients.batcher._queue.qsize() == 2)  # the request and the end
        clients.policy.gate.set()
        await asyncio.to_thread(closing.join)
        assert await first == 0
        with pytest.raises(asyncio.CancelledError):
            await second

    asyncio.run(work())
