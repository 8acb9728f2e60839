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
from tests.extras.serving.malformed import malformed_frames
from tests.extras.serving.stand_in import SPEC, StandIn, connect, observation, serving


def refusal(frame):
    """Return why a frame is refused; None if it is not. Anything but a ValueError is a bug."""
    try:
        requests.parse(wire.unpack(frame), SPEC)
    except ValueError as error:
        return str(error)
    return None


def test_10000_malformed_frames_are_refused_in_a_sentence():
    tracemalloc.start()
    sentences = [refusal(frame) for frame in malformed_frames(10_000)]
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    refused = [text for text in sentences if text is not None]
    assert all(text and "\n" not in text for text in refused)
    assert len(sentences) == 10_000
    assert 8500 < len(refused) < 9900  # the rest are damaged in a pixel or an ignored key
    assert peak < 20 * 2**20


def exchange(server, frame):
    """Send one frame on a new connection; return the reply."""
    with raw_connect(server.address, compression=None) as connection:
        connection.recv()
        connection.send(frame)
        return connection.recv(timeout=60)


def check_malformed(number):
    """Send malformed frames to a live server; return the numbers of errors and answers."""
    with serving(StandIn()) as server, connect(server) as bystander:
        replies = [exchange(server, frame) for frame in malformed_frames(number, seed=1)]
        sentences = [reply for reply in replies if isinstance(reply, str)]
        assert all(len(text) < 2000 and "\n" not in text for text in sentences)
        assert not any("Traceback" in text or "the server failed" in text for text in sentences)
        answers = [wire.unpack(reply) for reply in replies if isinstance(reply, bytes)]
        assert all(answer["actions"].shape == (10, 7) for answer in answers)
        np.testing.assert_array_equal(bystander.infer(observation())["actions"][0], np.arange(7))
        assert server.metrics["errors"] == len(sentences)
        assert server.metrics["open_connections"] == 1
    return len(sentences), len(answers)


def test_malformed_frames_over_the_network():
    errors, answers = check_malformed(400)
    assert errors + answers == 400
    assert errors > 340


@pytest.mark.slow
def test_10000_malformed_frames_over_the_network():
    errors, answers = check_malformed(10_000)
    print(f"{errors} refused, {answers} answered")
    assert errors + answers == 10_000


def test_oversized_frames_are_not_read():
    with serving(StandIn()) as server, raw_connect(server.address, compression=None) as client:
        client.recv()
        with contextlib.suppress(ConnectionClosed):  # the server need not read all of it
            client.send(bytes(wire.MAX_FRAME + 1))
        with pytest.raises(ConnectionClosed) as closed:
            client.recv()
        assert closed.value.rcvd.code == 1009
        with connect(server) as other:
            other.infer(observation())


def test_bytes_that_are_no_websocket():
    with serving(StandIn()) as server:
        for garbage in (b"", b"\0" * 100, b"GET / HTTP/1.1\r\n\r\n", os.urandom(1000)):
            with socket.create_connection(("127.0.0.1", server.port)) as raw:
                raw.sendall(garbage)
        with connect(server) as client:
            client.infer(observation())


def test_a_slow_client_does_not_delay_others():
    """One has sent half a request, another does not read its replies."""
    lazily = {"max_queue": 1, "close_timeout": 0.1}
    begun, over = threading.Event(), threading.Event()

    def send():
        yield wire.pack(observation())[:100]
        begun.set()
        over.wait(60)
        yield b"more"

    with (
        serving(StandIn()) as server,
        raw_connect(server.address, **lazily) as lazy,
        raw_connect(server.address) as half,
    ):
        thread = threading.Thread(target=half.send, args=[send()])
        thread.start()
        for _ in range(20):
            lazy.send(wire.pack(observation()))
        assert begun.wait(60)
        with connect(server) as client:
            start = time.perf_counter()
            for _ in range(20):
                client.infer(observation())
            assert time.perf_counter() - start < 10  # s, on the slowest machine
        over.set()
        thread.join()


def test_a_client_that_dies_during_inference():
    policy = StandIn()
    with serving(policy) as server, connect(server) as survivor:
        policy.gate.clear()
        with raw_connect(server.address) as dying:
            dying.recv()
            dying.send(wire.pack(observation()))
            while not policy.batches:
                time.sleep(0.001)
            dying.socket.shutdown(socket.SHUT_RDWR)
        policy.gate.set()
        np.testing.assert_array_equal(survivor.infer(observation())["actions"][0], np.arange(7))
        deadline = time.monotonic() + 60
        while server.metrics["open_connections"] > 1 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert server.metrics["open_connections"] == 1


def test_two_clients_at_once_get_their_own_answers():
    with serving(StandIn(seconds=0.001)) as server:
        wrong = []

        def work(value):
            with connect(server) as client:
                for i in range(50):
                    actions = client.infer(observation(value=value))["actions"]
                    if not (actions == np.arange(7) + value + i).all():
                        wrong.append((value, i))

        threads = [threading.Thread(target=work, args=[value]) for value in (10, 100)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert wrong == []
        assert server.metrics["requests"] == 100


SERVER = """
import threading
from tests.extras.serving.stand_in import StandIn, serving
policy = StandIn(seconds=60)
with serving(policy) as server:
    print(server.port, flush=True)
    threading.Event().wait()
"""


def test_a_server_killed_in_mid_chunk():
    command = [sys.executable, "-c", SERVER]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        port = int(process.stdout.readline())
        with PolicyClient(f"ws://127.0.0.1:{port}") as client:
            timer = threading.Timer(0.3, process.send_signal, [signal.SIGKILL])
            timer.start()
            # At once, as another sentence would tell of a reply that does not come in time.
            with pytest.raises(ServerGone, match=r"^ws://127.0.0.1:\d+ closed the connection$"):
                client.infer(observation())
            timer.join()


def memory_growth(number):
    """Return how much a process grows [MiB] over requests, after a tenth as many to warm up."""
    policy = StandIn()
    with serving(policy) as server, connect(server) as client:
        for i in range(number // 10 + number):
            if i == number // 10:
                gc.collect()
                before = psutil.Process().memory_info().rss
            client.infer(observation())
            policy.batches.clear()  # what the stand-in remembers is not the server's
            policy.indices.clear()
        gc.collect()
        return (psutil.Process().memory_info().rss - before) / 2**20


def test_memory_stays_flat():
    assert memory_growth(2000) < 4


@pytest.mark.slow
def test_memory_stays_flat_over_100000_requests():
    growth = memory_growth(100_000)
    print(f"{growth:.1f} MiB")
    assert growth < 4


@pytest.mark.slow
def test_memory_stays_flat_over_many_connections():
    with serving(StandIn()) as server:
        growth = []
        for _ in range(3000):
            with connect(server) as client:
                client.infer(observation())
            growth.append(psutil.Process().memory_info().rss)
        assert (growth[-1] - growth[1000]) / 2**20 < 16
