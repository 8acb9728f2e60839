"""A policy without a network, and a server in a thread of the test's process."""

import asyncio
import contextlib
import threading
import time

import numpy as np

from lorasp_jax.extras.serving.client import PolicyClient
from lorasp_jax.extras.serving.requests import PolicySpec
from lorasp_jax.extras.serving.server import PolicyServer, bind

SPEC = PolicySpec(("side", "wrist"), image_size=16, state_dim=7, chunk=10)


class StandIn:
    """Returns the state, plus the number of the request, plus the mean of the first picture.

    `indices` keeps the numbers of connections and of requests on them, `gate` holds every batch
    back until it is set, `seconds` is the time a batch takes, and `failure` is raised instead of an
    answer. `ranks` are the active ranks of a batch.
    """

    def __init__(self, spec=SPEC, *, seconds=0.0, adapters=("base",), instructions=(), metadata=()):
        self.metadata = dict(metadata)
        self.spec, self.sizes, self.seconds = spec, (1, 2, 4, 8), seconds
        self.instructions = dict.fromkeys(adapters, instructions)
        self.routing = "name"
        self.gate, self.failure, self.ranks = threading.Event(), None, None
        self.batches, self.indices = [], []
        self.gate.set()

    @property
    def denoise_steps(self):
        return dict.fromkeys(self.instructions, 10)

    @property
    def places(self):
        return dict.fromkeys(self.instructions, "nowhere")

    def route(self, request):
        adapter = request.adapter or next(iter(self.instructions))
        if adapter not in self.instructions:
            known = ", ".join(self.instructions)
            raise ValueError(f"adapter must be one of {known}, got {adapter!r}")
        return adapter

    def prepare(self, adapter, request, index):
        del adapter
        self.last_request = request
        self.indices.append(index)
        first = request.images[self.spec.cameras[0]]
        return request.state + index[1] + first.mean(dtype=np.float32)

    def run(self, adapter, rows):
        self.batches.append((str(adapter), len(rows)))
        self.gate.wait()
        time.sleep(self.seconds)
        if self.failure:
            raise self.failure
        offset = list(self.instructions).index(adapter) * 1000
        chunks = np.repeat(np.stack(rows)[:, None], self.spec.chunk, axis=1) + np.float32(offset)
        return chunks, None if self.ranks is None else self.ranks[: len(rows)]


@contextlib.contextmanager
def serving(policy, **options):
    """Serve in a thread; yields the server, with the attributes `address`, `port` and `policy`."""
    port = bind("127.0.0.1", options.pop("port", 0))
    server, loop = PolicyServer(policy, **options), asyncio.new_event_loop()
    started, stop = threading.Event(), asyncio.Event()

    async def run():
        async with server.listen(port):
            started.set()
            await stop.wait()

    thread = threading.Thread(target=lambda: loop.run_until_complete(run()), daemon=True)
    thread.start()
    assert started.wait(60)
    server.policy, server.port = policy, port.getsockname()[1]
    server.address = f"ws://127.0.0.1:{server.port}"
    try:
        yield server
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join(60)
        getattr(policy, "gate", threading.Event()).set()
        server.close()
        loop.run_until_complete(loop.shutdown_default_executor())
        loop.close()


def observation(spec=SPEC, value=0, **extra):
    picture = np.full((spec.image_size, spec.image_size, 3), value, np.uint8)
    state = np.arange(spec.state_dim, dtype=np.float32)
    return {"image": dict.fromkeys(spec.cameras, picture), "state": state, "prompt": "go", **extra}


def connect(server, **options):
    return PolicyClient(server.address, **options)
