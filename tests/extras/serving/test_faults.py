"""Test that nothing a client does, or fails to do, harms the server or other clients."""

import contextlib
import gc
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import tracemalloc

import numpy as np
import psutil
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect as raw_connect

from lorasp_jax.extras.serving import requests, wire
from lorasp_jax.extras.serving.client import PolicyClient, ServerGone
from tests import ROOT
from tests.cases import mostly_slow
from tests.extras.serving.malformed import malformed_frames
from tests.extras.serving.stand_in import SPEC, StandIn, connect, observation, serving


@pytest.fixture
def server():
    """A server that answers a bystander at the end, and has forgotten all other clients."""
    with serving(StandIn()) as server, connect(server) as bystander:
        yield server
        deadline = time.monotonic() + 60
        while server.counts["open_connections"] > 1 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert server.counts["open_connections"] == 1
        np.testing.assert_array_equal(bystander.infer(observation())["actions"][0], np.arange(7))


def refusal(frame):
    """Return why a frame is refused; None if it is not. Anything but a ValueError is a bug."""
    try:
        requests.parse(wire.unpack(frame), SPEC)
    except ValueError as error:
        return str(error)
    return None


def test_malformed_frames_are_refused_in_a_sentence():
    tracemalloc.start()
    sentences = [refusal(frame) for frame in malformed_frames(2000)]
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    refused = [text for text in sentences if text is not None]
    assert all(text and "\n" not in text for text in refused)
    assert 1700 < len(refused) < 1980  # the rest are damaged in a pixel or an ignored key
    assert peak < 20 * 2**20


@pytest.mark.parametrize("number", mostly_slow([100, 10_000], [100]))
def test_malformed_frames_over_the_network(server, number):
    replies = []
    for frame in malformed_frames(number, seed=1):
        with raw_connect(server.address, compression=None) as connection:
            connection.recv()
            connection.send(frame)
            replies.append(connection.recv(timeout=60))
    sentences = [reply for reply in replies if isinstance(reply, str)]
    assert all(len(text) < 2000 and "\n" not in text for text in sentences)
    assert not any("Traceback" in text or "the server failed" in text for text in sentences)
    answers = [wire.unpack(reply) for reply in replies if isinstance(reply, bytes)]
    assert all(answer["actions"].shape == (10, 7) for answer in answers)
    assert server.counts["errors"] == len(sentences) > 0.85 * number
    print(f"{len(sentences)} refused, {len(answers)} answered")


def test_oversized_frames_are_not_read(server):
    with raw_connect(server.address, compression=None) as client:
        client.recv()
        with contextlib.suppress(ConnectionClosed):  # the server need not read all of it
            client.send(bytes(wire.MAX_FRAME + 1))
        with pytest.raises(ConnectionClosed) as closed:
            client.recv()
        assert closed.value.rcvd.code == 1009


def test_bytes_that_are_no_websocket(server):
    for garbage in (b"", b"\0" * 100, b"GET / HTTP/1.1\r\n\r\n", os.urandom(1000)):
        with socket.create_connection(("127.0.0.1", server.port)) as raw:
            raw.sendall(garbage)


def test_a_slow_client_does_not_delay_others(server):
    """One has sent half a request, another does not read its replies."""
    begun, over = threading.Event(), threading.Event()

    def send():
        yield wire.pack(observation())[:100]
        begun.set()
        over.wait(60)
        yield b"more"

    with (
        raw_connect(server.address, max_queue=1, close_timeout=0.1) as lazy,
        raw_connect(server.address) as half,
        connect(server) as client,
    ):
        thread = threading.Thread(target=half.send, args=[send()])
        thread.start()
        for _ in range(20):
            lazy.send(wire.pack(observation()))
        assert begun.wait(60)
        start = time.perf_counter()
        for _ in range(20):
            client.infer(observation())
        assert time.perf_counter() - start < 10  # s, on the slowest machine
        over.set()
        thread.join()


def test_a_client_that_dies_during_inference(server):
    server.policy.gate.clear()
    with raw_connect(server.address) as dying:
        dying.recv()
        dying.send(wire.pack(observation()))
        while not server.policy.batches:
            time.sleep(0.001)
        dying.socket.shutdown(socket.SHUT_RDWR)
    server.policy.gate.set()


def test_two_clients_at_once_get_their_own_answers(server):
    wrong = []

    def work(value):
        with connect(server) as client:
            for i in range(30):
                actions = client.infer(observation(value=value))["actions"]
                if not (actions == np.arange(7) + value + i).all():
                    wrong.append((value, i))

    threads = [threading.Thread(target=work, args=[value]) for value in (10, 100)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
    assert server.counts["requests"] == 60


SERVER = """
from tests.extras.serving.stand_in import StandIn, serving
with serving(StandIn(seconds=60)) as server:
    print(server.port, flush=True)
    input()
"""


def test_a_server_killed_in_mid_chunk():
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", SERVER], cwd=ROOT, text=True, **pipes) as process:
        port = int(process.stdout.readline())
        with PolicyClient(f"ws://127.0.0.1:{port}") as client:
            timer = threading.Timer(0.3, process.send_signal, [signal.SIGKILL])
            timer.start()
            # At once, as another sentence would tell of a reply that does not come in time.
            with pytest.raises(ServerGone, match=r"^ws://127.0.0.1:\d+ closed the connection$"):
                client.infer(observation())
            timer.join()


@pytest.mark.slow
@pytest.mark.parametrize(("connections", "requests", "limit"), [(1, 100_000, 4), (2000, 1, 16)])
def test_memory_stays_flat(connections, requests, limit):
    """After half as much to warm up."""
    policy, sizes = StandIn(), []
    with serving(policy) as server:
        for _ in range(connections + connections // 2):
            with connect(server) as client:
                for i in range(requests + requests // 2):
                    client.infer(observation())
                    policy.batches.clear()  # what the stand-in remembers is not the server's
                    policy.indices.clear()
                    if (i + 1) % (requests // 2 or 1) == 0:
                        gc.collect()
                        sizes.append(psutil.Process().memory_info().rss)
    print(f"{(sizes[-1] - sizes[len(sizes) // 3]) / 2**20:.1f} MiB")
    assert (sizes[-1] - sizes[len(sizes) // 3]) / 2**20 < limit
