"""Test how requests of several clients become batches."""

import asyncio
import threading
import time

import numpy as np
import pytest

from lorasp_jax.extras.serving import batching
from lorasp_jax.extras.serving.batching import Batcher, PolicyFailure
from lorasp_jax.extras.serving.metrics import Metrics
from tests.extras.serving.stand_in import SPEC, StandIn


class Clients:
    """Runs requests of several clients against a batcher."""

    def __init__(self, policy):
        self.policy, self.metrics = policy, Metrics()
        self.batcher = Batcher(policy, self.metrics)

    async def ask(self, client, adapter="base"):
        row = np.full(SPEC.state_dim, client, np.float32)
        answer = await self.batcher.infer(client, adapter, row)
        return float(answer.actions[0, 0])

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
    policy = StandIn(sizes=(1, 2, 4))
    clients = Clients(policy)

    async def work():
        policy.gate.clear()
        first = asyncio.create_task(clients.ask(0))
        await until(lambda: policy.batches)
        others = [asyncio.create_task(clients.ask(i)) for i in range(1, 8)]
        await asyncio.sleep(0.02)
        policy.gate.set()
        return await asyncio.gather(first, *others)

    assert clients.run(work()) == list(range(8))
    assert policy.batches == [("base", 1), ("base", 4), ("base", 4)]
    assert clients.metrics["batched_requests"] == 8
    assert clients.metrics["batches"] == 3


def test_every_adapter_has_its_own_batches_in_order_of_arrival():
    policy = StandIn(adapters=("base", "a", "b"))
    clients = Clients(policy)

    async def work():
        policy.gate.clear()
        names = ["base", "a", "b", "a", "b"]
        tasks = []
        for i, name in enumerate(names):
            tasks.append(asyncio.create_task(clients.ask(i, name)))
            await until(lambda: policy.batches)
        await asyncio.sleep(0.02)
        policy.gate.set()
        return await asyncio.gather(*tasks)

    assert clients.run(work()) == [0, 1001, 2002, 1003, 2004]
    assert policy.batches == [("base", 1), ("a", 2), ("b", 2)]


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
    policy = StandIn(seconds=0.005)
    clients = Clients(policy)

    async def client(number):
        for _ in range(30):
            await clients.ask(number)

    async def work():
        await asyncio.gather(*(client(i) for i in range(8)))

    clients.run(work())
    assert clients.metrics["batched_requests"] == 240
    assert clients.metrics["batches"] <= 40


def test_a_client_that_does_not_come_back_delays_others_briefly():
    policy = StandIn()
    clients = Clients(policy)

    async def work():
        await clients.ask(0)
        start = time.perf_counter()
        await clients.ask(1)
        return time.perf_counter() - start

    assert clients.run(work()) < batching.WAIT + 5  # s; a busy machine may switch threads late


def test_a_failure_reaches_every_client_of_the_batch_and_the_log():
    policy, failures = StandIn(), []
    clients = Clients(policy)
    clients.batcher._on_failure = failures.append
    policy.failure = RuntimeError("out of memory")

    async def work():
        with pytest.raises(PolicyFailure, match="see the server's log"):
            await clients.ask(0)
        policy.failure = None
        return await clients.ask(1)

    assert clients.run(work()) == 1
    assert [str(error) for error in failures] == ["out of memory"]


def test_rows_of_clients_that_have_gone_are_not_run():
    policy = StandIn()
    clients = Clients(policy)

    async def work():
        policy.gate.clear()
        first = asyncio.create_task(clients.ask(0))
        await until(lambda: policy.batches)
        gone = asyncio.create_task(clients.ask(1))
        await asyncio.sleep(0.01)
        gone.cancel()
        await asyncio.sleep(0.01)
        policy.gate.set()
        await first
        return await clients.ask(2)

    assert clients.run(work()) == 2
    assert policy.batches == [("base", 1), ("base", 1)]


def test_one_bad_row_does_not_spoil_the_others():
    policy = StandIn()
    clients = Clients(policy)

    async def work():
        policy.gate.clear()
        first = asyncio.create_task(clients.ask(0))
        await until(lambda: policy.batches)
        tasks = [asyncio.create_task(clients.ask(i)) for i in (1, np.nan, 3)]
        await asyncio.sleep(0.02)
        policy.gate.set()
        await first
        return await asyncio.gather(*tasks, return_exceptions=True)

    one, bad, three = clients.run(work())
    assert (one, three) == (1, 3)
    assert isinstance(bad, PolicyFailure)


def test_closing_cancels_what_waits():
    policy = StandIn()
    clients = Clients(policy)

    async def work():
        policy.gate.clear()
        first = asyncio.create_task(clients.ask(0))
        await until(lambda: policy.batches)
        second, waiting = asyncio.create_task(clients.ask(1)), clients.batcher._queue.qsize
        await until(lambda: waiting() == 1)
        closing = threading.Thread(target=clients.batcher.close)
        closing.start()
        await until(lambda: waiting() == 2)  # the request and the end
        policy.gate.set()
        await asyncio.to_thread(closing.join)
        assert await first == 0
        with pytest.raises(asyncio.CancelledError):
            await second

    asyncio.run(work())
