"""Test the client against servers that are late, slow or gone."""

import signal
import socket
import ssl
import subprocess
import sys
import threading
import time
from unittest.mock import Mock

import numpy as np
import pytest
from websockets.datastructures import Headers
from websockets.exceptions import InvalidMessage, InvalidStatus
from websockets.http11 import Response
from websockets.sync.server import serve

from lorasp_jax.extras.serving import client as client_module
from lorasp_jax.extras.serving import wire
from lorasp_jax.extras.serving.client import PolicyClient, PolicyError, ServerGone
from tests import ROOT
from tests.extras.serving.stand_in import StandIn, connect, observation, serving


@pytest.fixture
def free_port():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return taken.getsockname()[1]


@pytest.mark.parametrize("address", ["nonsense", "http://127.0.0.1:1", "ws://127.0.0.1:x"])
def test_addresses_that_are_none(address):
    with pytest.raises((ServerGone, ValueError)):
        PolicyClient(address)


def test_waiting_for_a_server(free_port):
    clients = []
    address = f"ws://127.0.0.1:{free_port}"
    thread = threading.Thread(target=lambda: clients.append(PolicyClient(address, wait=30)))
    thread.start()
    time.sleep(0.5)
    with serving(StandIn(), port=free_port):
        thread.join(30)
        with clients[0] as client:
            assert client.metadata["action_dim"] == 7


def test_waiting_has_an_end(free_port):
    with pytest.raises(ServerGone, match=f"^no policy server at ws://127.0.0.1:{free_port}: "):
        PolicyClient(f"ws://127.0.0.1:{free_port}", wait=0.3)


def untrusted(message):
    error = ssl.SSLCertVerificationError(1, "certificate verify failed")
    error.verify_message = message
    return error


REASONS = {
    "refused": ConnectionRefusedError("refused"),
    "two addresses": OSError("Multiple exceptions: [Errno 111] a, [Errno 111] b"),
    "no name yet": socket.gaierror(-2, "Name or service not known"),
    "unreachable": OSError(113, "No route to host"),
    "no HTTP": InvalidMessage("did not receive a valid HTTP response"),
    **{str(code): InvalidStatus(Response(code, "", Headers(), b"no")) for code in (502, 503, 504)},
}
LASTING = {
    **{str(code): InvalidStatus(Response(code, "", Headers(), b"no")) for code in (401, 403, 404)},
    "certificate": untrusted("self-signed certificate"),
    "no encryption": ssl.SSLError(1, "wrong version number"),
}


@pytest.mark.parametrize("reason", REASONS.values(), ids=REASONS)
def test_what_may_pass_is_tried_again(reason, monkeypatch):
    """Each reason lasts for two attempts, and is told once."""
    attempts, said = [reason, reason], []

    def connect_later(*arguments, **options):
        if attempts:
            raise attempts.pop()
        return connect_now(*arguments, **options)

    connect_now = client_module.connect
    monkeypatch.setattr(client_module, "connect", connect_later)
    monkeypatch.setattr(client_module, "RETRY_EVERY", 0.01)
    with serving(StandIn()) as server:
        PolicyClient(server.address, wait=30, say=said.append).close()
    assert len(said) == 1
    assert "trying again" in said[0]


@pytest.mark.parametrize("reason", LASTING.values(), ids=LASTING)
def test_what_does_not_pass_is_not_waited_for(reason, monkeypatch):
    monkeypatch.setattr(client_module, "connect", Mock(side_effect=reason))
    start = time.monotonic()
    with pytest.raises(ServerGone):
        PolicyClient("wss://127.0.0.1:1", wait=30)
    assert time.monotonic() - start < 10


def test_a_missing_certificate_is_named(monkeypatch):
    """Python ignores a file that does not exist."""
    error = untrusted("unable to get local issuer certificate")
    monkeypatch.setattr(client_module, "connect", Mock(side_effect=error))
    for file, words in (("nowhere.pem", "nowhere.pem, which does not exist"), ("", "let SSL_C")):
        monkeypatch.setenv("SSL_CERT_FILE", file)
        with pytest.raises(ServerGone, match=f"local issuer certificate.*{words}"):
            PolicyClient("wss://127.0.0.1:1")


def test_closing_ends_a_call_of_another_thread():
    policy = StandIn()
    policy.gate.clear()
    with serving(policy) as server, connect(server) as client:
        gone = []

        def ask():
            with pytest.raises(ServerGone) as error:
                client.infer(observation(), timeout=600)
            gone.append(error)

        thread = threading.Thread(target=ask)
        thread.start()
        while not policy.batches:
            time.sleep(0.001)
        client.close()
        thread.join(30)
        assert gone
        policy.gate.set()


def test_a_late_reply_is_never_taken_for_the_next_one():
    policy = StandIn()
    with serving(policy) as server, connect(server) as client:
        policy.gate.clear()
        with pytest.raises(ServerGone, match=r"did not reply within 0\.2 s"):
            client.infer(observation(), timeout=0.2)
        policy.gate.set()
        with pytest.raises(ServerGone, match=r"the connection to .* is closed"):
            client.infer(observation())


@pytest.mark.parametrize(
    ("reply", "words"), [(b"\xc1", "malformed: the frame"), (wire.pack([1]), "a map, got a list")]
)
def test_a_malformed_reply_is_the_policys_error(reply, words):
    def answer(socket):
        socket.send(wire.pack({}))
        socket.recv()
        socket.send(reply)

    with serve(answer, "127.0.0.1", 0, compression=None) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        with PolicyClient(address) as client, pytest.raises(PolicyError, match=words):
            client.infer({})
        server.shutdown()


def test_a_server_that_stops():
    with serving(StandIn()) as server:
        client = connect(server)
        client.infer(observation())
    with pytest.raises(ServerGone, match="closed the connection"):
        client.infer(observation())
    client.close()


@pytest.fixture
def interruptible():
    """Make SIGINT raise KeyboardInterrupt; a shell's background processes ignore it."""
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, previous)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupted_call_closes_the_connection():
    """As its reply could be taken for the next one."""
    policy = StandIn()
    with serving(policy) as server, connect(server) as client:
        policy.gate.clear()

        def interrupt():
            while not policy.batches:  # the call waits for its reply
                time.sleep(0.001)
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

        threading.Thread(target=interrupt, daemon=True).start()
        with pytest.raises(KeyboardInterrupt):
            client.infer(observation())
        policy.gate.set()
        with pytest.raises(ServerGone, match="is closed"):
            client.infer(observation())


def test_values_that_cannot_be_sent_do_not_end_the_connection():
    with serving(StandIn()) as server, connect(server) as client:
        client.infer(observation())
        with pytest.raises(TypeError, match="a message cannot contain a complex"):
            client.infer(observation(extra=1j))
        np.testing.assert_array_equal(client.infer(observation())["actions"][0], np.arange(7) + 1)


def test_the_client_imports_little():
    code = (
        "import sys, lorasp_jax.extras.serving.client, lorasp_jax.extras.serving.wire\n"
        "files = {name: getattr(module, '__file__', '') for name, module in sys.modules.items()}\n"
        "print(*{n.partition('.')[0] for n, file in files.items() if 'site-packages' in str(file)})"
    )
    command = [sys.executable, "-c", code]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    third_party = {name for name in process.stdout.split() if not name.startswith("_")}
    assert third_party <= {"numpy", "msgpack", "websockets", "lazy_loader"}
