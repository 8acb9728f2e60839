"""Test the protocol between the server and clients."""

import dataclasses
import json
import socket
import threading
import time
import urllib.error
import urllib.request

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import connect as raw_connect

from lorasp_jax.extras.serving import batching, wire
from lorasp_jax.extras.serving.client import PolicyError, ServerGone
from lorasp_jax.extras.serving.server import bind
from tests.extras.serving.stand_in import SPEC, StandIn, connect, observation, serving


@pytest.fixture(scope="module")
def server():
    with serving(StandIn(adapters=("base", "pour"), metadata={"robot": "piper"})) as server:
        yield server


@pytest.fixture
def client(server):
    with connect(server) as client:
        yield client


def page(server, path, **headers):
    url = f"http://127.0.0.1:{server.port}{path}"
    with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=60) as reply:
        return reply.read().decode()


def test_the_server_speaks_first(client):
    expected = {
        "robot": "piper",
        "cameras": ["side", "wrist"],
        "action_horizon": 10,
        "action_dim": 7,
        "adapters": ["base", "pour"],
        "instructions": {"base": [], "pour": []},
    }
    assert client.metadata | expected == client.metadata


def test_replies(client):
    first, second = client.infer(observation(value=100)), client.infer(observation())
    assert (first["actions"].shape, first["actions"].dtype) == ((SPEC.chunk, 7), np.float32)
    np.testing.assert_array_equal(first["actions"][0], np.arange(7) + 100)
    np.testing.assert_array_equal(second["actions"][0], np.arange(7) + 1)
    assert first["policy_timing"].keys() == {"infer_ms"}
    assert first["server_timing"].keys() == {"infer_ms"}
    assert second["server_timing"].keys() == {"infer_ms", "prev_total_ms"}


def test_no_two_requests_have_the_same_noise():
    policy = StandIn()
    with serving(policy) as server, connect(server) as client:
        for _ in range(2):
            client.infer(observation())
            client.reset()
        with connect(server) as other:
            other.infer(observation())
            client.infer(observation())
    assert policy.indices == [(0, 0), (0, 1), (1, 0), (0, 2)]


def test_a_connection_has_a_previous_chunk():
    policy = StandIn(dataclasses.replace(SPEC, execution="trained"))
    with serving(policy) as server, connect(server) as client:
        first = client.infer(observation())["actions"]
        client.infer(observation(executed=2, delay=1))
        np.testing.assert_array_equal(policy.last_request.previous, first)
        client.reset()
        client.infer(observation())
        assert policy.last_request.previous is None
        client.reset()
        with pytest.raises(PolicyError, match="first request of an episode"):
            client.infer(observation(executed=2))


def test_adapters_are_chosen_by_a_key(client):
    base, pour = (client.infer(observation(adapter=name)) for name in ("base", "pour"))
    assert pour["actions"][0, 0] == base["actions"][0, 0] + 1001
    with pytest.raises(PolicyError, match="one of base, pour, got 'fly'"):
        client.infer(observation(adapter="fly"))


@pytest.mark.parametrize(
    ("frame", "refusal"), [(wire.pack({"state": 1}), "must have the keys"), ("hello", "binary")]
)
def test_an_error_is_one_sentence_and_closes_the_connection(server, frame, refusal):
    with raw_connect(server.address) as socket:
        socket.recv()
        socket.send(frame)
        sentence = socket.recv()
        assert refusal in sentence
        assert "\n" not in sentence
        with pytest.raises(ConnectionClosedError) as closed:
            socket.recv()
    assert closed.value.rcvd.code == 1011


def test_a_failing_policy_shows_no_traceback(caplog):
    policy = StandIn()
    policy.failure = RuntimeError("secret")
    with serving(policy) as server, connect(server) as client:
        with pytest.raises(PolicyError, match=r"^the policy failed: see the server's log$"):
            client.infer(observation())
        policy.failure = None
        with connect(server) as another:
            another.infer(observation())
    assert "secret" in caplog.text


def test_health_and_status_during_inference():
    policy = StandIn()
    policy.gate.clear()
    with serving(policy) as server, connect(server) as client:
        thread = threading.Thread(target=client.infer, args=[observation()])
        thread.start()
        while not policy.batches:
            time.sleep(0.001)
        assert page(server, "/healthz") == "OK\n"
        counts = json.loads(page(server, "/status"))
        assert (counts["open_connections"], counts["requests"]) == (1, 0)
        policy.gate.set()  # only now, so inference has not ended before
        thread.join()
        assert json.loads(page(server, "/status"))["batched_requests"] == 1


def health(server):
    """Return status and text of the page."""
    try:
        return 200, page(server, "/healthz")
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def test_health_means_that_the_policy_answers(monkeypatch):
    monkeypatch.setattr(batching, "HUNG", 0.05)
    policy = StandIn()
    with serving(policy) as server, connect(server) as client:
        assert health(server) == (200, "OK\n")
        policy.gate.clear()
        thread = threading.Thread(target=client.infer, args=[observation()])
        thread.start()
        end = time.monotonic() + 60
        while (status := health(server))[0] == 200 and time.monotonic() < end:
            time.sleep(0.01)
        assert status[0] == 503
        assert "has not answered for" in status[1]
        policy.gate.set()
        thread.join()
        assert health(server) == (200, "OK\n")
        policy.failure = RuntimeError("out of memory")
        with pytest.raises(PolicyError):
            client.infer(observation())
        assert health(server) == (503, "the policy failed when it was last asked\n")
        policy.failure = None
        with connect(server) as another:
            another.infer(observation())
        assert health(server) == (200, "OK\n")


def test_closing_does_not_wait_for_a_hung_policy():
    policy = StandIn()
    policy.gate.clear()
    with serving(policy) as server, connect(server) as client, connect(server) as late:
        refusals = []

        def ask():
            with pytest.raises(PolicyError) as refusal:
                client.infer(observation())
            refusals.append(str(refusal.value))

        thread = threading.Thread(target=ask)
        thread.start()
        while not policy.batches:
            time.sleep(0.001)
        assert not server.close(0.01)
        thread.join()
        assert refusals == ["the policy does not answer"]
        with pytest.raises(PolicyError, match="the server is closing"):
            late.infer(observation())
        policy.gate.set()
        assert server.close(60)
        assert health(server) == (503, "the policy's thread has ended\n")


ODD = (
    "Authorization: Api-Key secret\r\nAuthorization: Api-Key secret", "Authorization: \xff",
    "Authorization: \x01", "X: " + "a" * 9000, "Content-Length: x", "NoColon", ": empty",
    "Sec-WebSocket-Extensions: ;;;", "Sec-WebSocket-Key: x", "Connection: close",
)  # fmt: skip


@pytest.mark.parametrize("lines", ODD)
def test_odd_headers_are_refused_without_a_traceback(lines, caplog):
    with serving(StandIn(), token="secret") as server:
        with socket.create_connection(("127.0.0.1", server.port), timeout=60) as raw:
            raw.sendall(f"GET / HTTP/1.1\r\nHost: x\r\n{lines}\r\n\r\n".encode("latin1"))
            status = raw.recv(100).partition(b"\r\n")[0]  # empty: it was not HTTP
        assert status == b"" or status.startswith(b"HTTP/1.1 4")
        if "secret" in lines:
            assert b" 400 " in status
    assert not [record for record in caplog.records if record.exc_info]


def series(text):
    """Return the values by name with labels, and the types by name."""
    lines = [line.rsplit(" ", 1) for line in text.splitlines()]
    types = {name.split()[-1]: kind for name, kind in lines if name.startswith("# TYPE")}
    return {name: float(value) for name, value in lines if name[0] != "#"}, types


def test_metrics_are_prometheus_series():
    policy = StandIn(adapters=("base", 'a"b'), seconds=0.003)
    with serving(policy) as server, connect(server) as client:
        client.infer(observation())
        for _ in range(2):
            client.infer(observation(adapter='a"b'))
        address = f"http://127.0.0.1:{server.port}/metrics"
        with urllib.request.urlopen(address, timeout=60) as reply:
            assert "version=0.0.4" in reply.headers["Content-Type"]
            values, types = series(reply.read().decode())
    assert values["lorasp_jax_requests_total"] == 3
    assert values["lorasp_jax_open_connections"] == 1
    assert types["lorasp_jax_open_connections"] == "gauge"
    for name in ("lorasp_jax_request_seconds", "lorasp_jax_batch_seconds"):
        assert types[name] == "histogram"
        for adapter, count in (("base", 1), ('a\\"b', 2)):
            label = f'adapter="{adapter}"'
            buckets = [v for k, v in values.items() if k.startswith(f"{name}_bucket{{{label},")]
            assert buckets == sorted(buckets)
            assert values[f'{name}_bucket{{{label},le="0.002"}}'] == 0
            assert values[f'{name}_bucket{{{label},le="+Inf"}}'] == count
            assert values[f"{name}_count{{{label}}}"] == count
            assert values[f"{name}_sum{{{label}}}"] >= 0.003 * count


def test_the_log_has_connections_and_refusals(caplog):
    caplog.set_level("INFO", "lorasp_jax.extras.serving")
    with (
        serving(StandIn(), token="secret", max_clients=1) as server,
        connect(server, token="secret") as client,
    ):
        for token in ("", "secret"):
            with pytest.raises(ServerGone):
                connect(server, token=token)
        client.infer(observation())
        with pytest.raises(PolicyError):
            client.infer(observation(prompt=3))
    first, *refused, asked, left = [record.message for record in caplog.records]
    assert first.startswith("client 0 connected from 127.0.0.1 port ")
    assert [text.partition(": ")[2][:11] for text in refused] == ["this server", "this server"]
    assert "requires a token" in refused[0]
    assert "maximum of 1" in refused[1]
    assert asked.startswith("client 0 is refused: prompt must be text")
    assert left == "client 0 left after 1 requests"


def test_keys_without_a_meaning_are_logged_once(caplog):
    with serving(StandIn()) as server:
        for _ in range(2):
            with connect(server) as client:
                client.infer(observation(promt="press it"))
                client.infer(observation(promt="press it", adaptor="a"))
    warnings = [record.args[0] for record in caplog.records if record.levelname == "WARNING"]
    assert warnings == ["promt", "adaptor"]


def test_a_token_is_required():
    with serving(StandIn(), token="secret") as server:
        for wrong in ({}, {"token": "wrong"}):
            with pytest.raises(ServerGone, match=r"\(401\): .*token"):
                connect(server, **wrong)
        with connect(server, token="secret") as client:
            client.infer(observation())
        assert page(server, "/healthz") == "OK\n"
        assert '"connections": 1' in page(server, "/status", Authorization="Api-Key secret")
        with pytest.raises(urllib.error.HTTPError) as error:
            page(server, "/status")
        error.value.close()


def test_other_addresses_need_a_token():
    with pytest.raises(ValueError, match=r"anyone who reaches 0\.0\.0\.0"):
        bind("0.0.0.0", 0)
    bind("0.0.0.0", 0, token="secret").close()
    for host in ("127.0.0.1", "127.8.8.8", "localhost"):
        bind(host, 0).close()


def test_ports_that_cannot_be_used(server):
    with pytest.raises(ValueError, match=r"127\.0\.0\.1, port \d+: Address already"):
        bind("127.0.0.1", server.port)
    with pytest.raises(ValueError, match=r"192\.0\.2\.1, port 0: Cannot assign"):
        bind("192.0.2.1", 0, token="secret")
    with pytest.raises(ValueError, match="0 to 65535, got 99999"):
        bind("127.0.0.1", 99999)


def test_pages_in_browsers_are_refused(server):
    """Otherwise any web page could use a server on the visitor's machine."""
    with pytest.raises(InvalidStatus, match="HTTP 403"):
        raw_connect(server.address, origin="https://example.org")


def test_too_many_connections_are_refused():
    with serving(StandIn(), max_clients=2) as server, connect(server), connect(server):  # noqa: SIM117
        with pytest.raises(ServerGone, match=r"\(503\): .*maximum of 2"):
            connect(server)
