"""Test the protocol between the server and clients."""

import asyncio
import dataclasses
import ssl
import threading
import time
import urllib.error
import urllib.request

import numpy as np
import pytest
import trustme
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import connect as raw_connect

from lorasp_jax.extras.serving import server as server_module
from lorasp_jax.extras.serving import wire
from lorasp_jax.extras.serving.client import PolicyError, ServerGone
from lorasp_jax.extras.serving.server import PolicyServer, bind, check_exposure, tls_context
from tests.extras.serving.stand_in import SPEC, StandIn, connect, observation, serving


@pytest.fixture(scope="module")
def server():
    with serving(StandIn(adapters=("base", "pour")), metadata={"robot": "piper"}) as server:
        yield server


def page(server, path, **headers):
    url = f"http://127.0.0.1:{server.port}{path}"
    with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=60) as reply:
        return reply.read().decode()


def test_the_server_speaks_first(server):
    with connect(server) as client:
        assert client.metadata["robot"] == "piper"
        assert client.metadata["cameras"] == ["side", "wrist"]
        assert (client.metadata["action_horizon"], client.metadata["action_dim"]) == (10, 7)
        assert client.metadata["adapters"] == ["base", "pour"]
        assert client.metadata["instructions"] == {"base": [], "pour": []}


def test_replies(server):
    with connect(server) as client:
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


def test_a_session_keeps_the_previous_chunk():
    policy = StandIn(dataclasses.replace(SPEC, execution="trained"))
    with serving(policy) as server, connect(server) as client:
        first = client.infer(observation())["actions"]
        client.infer(observation(executed=2, delay=1))
        np.testing.assert_array_equal(policy.last_request.previous, first)
        client.reset()
        client.infer(observation())
        assert policy.last_request.previous is None
        client.reset()
        with pytest.raises(PolicyError, match="first request of an episode must not have the key"):
            client.infer(observation(executed=2))


def test_forms_of_openpi_get_as_many_dimensions_as_their_clients_expect():
    spec = dataclasses.replace(SPEC, state_dim=8)
    picture = np.zeros((16, 16, 3), np.uint8)
    pictures = {"observation/image": picture, "observation/wrist_image": picture}
    with serving(StandIn(spec)) as server, connect(server) as client:
        reply = client.infer({"observation/state": np.zeros(8), **pictures})
        assert reply["actions"].shape == (10, 7)


def test_adapters_are_chosen_by_a_key(server):
    with connect(server) as client:
        base, pour = (client.infer(observation(adapter=name)) for name in ("base", "pour"))
        assert pour["actions"][0, 0] == base["actions"][0, 0] + 1001
        with pytest.raises(PolicyError, match=r"^adapter must be one of base, pour, got 'fly'$"):
            client.infer(observation(adapter="fly"))


def test_an_error_is_one_sentence_and_closes_the_connection(server):
    with raw_connect(server.address) as socket:
        socket.recv()
        socket.send(wire.pack({"state": 1}))
        sentence = socket.recv()
        assert isinstance(sentence, str)
        assert sentence.startswith("a request must have the keys")
        assert "Traceback" not in sentence
        assert "\n" not in sentence
        with pytest.raises(ConnectionClosedError) as closed:
            socket.recv()
    assert closed.value.rcvd.code == 1011


def test_text_frames_are_refused(server):
    with raw_connect(server.address) as socket:
        socket.recv()
        socket.send("hello")
        assert socket.recv() == "a request must be a binary frame"


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


def test_actions_that_are_not_finite_are_not_sent():
    policy = StandIn()
    policy.prepare = lambda request, index: request.state + np.float32(np.nan)
    with (
        serving(policy) as server,
        connect(server) as client,
        pytest.raises(PolicyError, match="actions that are not finite"),
    ):
        client.infer(observation())


def test_health_and_metrics_during_inference():
    policy = StandIn()
    policy.gate.clear()
    with serving(policy) as server, connect(server) as client:
        thread = threading.Thread(target=client.infer, args=[observation()])
        thread.start()
        while not policy.batches:
            time.sleep(0.001)
        assert page(server, "/healthz") == "OK\n"
        assert "lorasp_jax_open_connections 1" in page(server, "/metrics")
        policy.gate.set()  # only now, so inference has not ended before
        thread.join()
        text = page(server, "/metrics")
    assert "lorasp_jax_requests 1" in text
    assert "# policy infer" in text


def test_a_token_is_required():
    with serving(StandIn(), token="secret") as server:
        with pytest.raises(ServerGone, match=r"refused the connection \(401\): .*requires a token"):
            connect(server)
        with pytest.raises(ServerGone, match="401"):
            connect(server, token="wrong")
        with connect(server, token="secret") as client:
            client.infer(observation())
        assert page(server, "/healthz") == "OK\n"
        assert "requests 1" in page(server, "/metrics", Authorization="Api-Key secret")
        with pytest.raises(urllib.error.HTTPError) as error:
            page(server, "/metrics")
        error.value.close()


def test_other_addresses_need_a_token():
    with bind("0.0.0.0", 0) as port:
        with pytest.raises(ValueError, match=r"anyone who reaches 0\.0\.0\.0 could use the policy"):
            check_exposure(port, "")
        check_exposure(port, "secret")
        server = PolicyServer(StandIn())
        with pytest.raises(ValueError, match="anyone who reaches"):
            asyncio.run(server.listen(port).__aenter__())
        server.close()


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.8.8", "localhost"])
def test_this_machine_needs_none(host):
    with bind(host, 0) as port:
        check_exposure(port, "")


def test_ports_that_cannot_be_used(server):
    with pytest.raises(
        ValueError, match=r"cannot listen on 127\.0\.0\.1, port \d+: Address already"
    ):
        bind("127.0.0.1", server.port)
    with pytest.raises(ValueError, match=r"cannot listen on 192\.0\.2\.1, port 0: Cannot assign"):
        bind("192.0.2.1", 0)
    with pytest.raises(ValueError, match="the port must be 0 to 65535, got 99999"):
        bind("127.0.0.1", 99999)


def test_pages_in_browsers_are_refused(server):
    """Otherwise any web page could use a server on the visitor's machine."""
    with (
        pytest.raises(InvalidStatus, match="HTTP 403"),
        raw_connect(server.address, origin="https://example.org"),
    ):
        pass


def test_encryption(tmp_path):
    authority = trustme.CA()
    certificate = authority.issue_cert("127.0.0.1")
    certificate.private_key_and_cert_chain_pem.write_to_path(str(tmp_path / "server.pem"))
    authority.cert_pem.write_to_path(str(tmp_path / "ca.pem"))
    tls = tls_context(tmp_path / "server.pem", tmp_path / "server.pem")
    with serving(StandIn(), tls=tls) as server:
        with connect(server, certificate=str(tmp_path / "ca.pem")) as client:
            assert client.infer(observation())["actions"].shape == (10, 7)
        with pytest.raises(ServerGone, match="certificate verify failed"):
            connect(server)


def test_bad_certificates(tmp_path):
    (tmp_path / "empty.pem").write_text("")
    with pytest.raises(ValueError, match=r"cannot use .*empty\.pem"):
        tls_context(tmp_path / "empty.pem", tmp_path / "empty.pem")
    with pytest.raises(ValueError, match=r"cannot use .*absent\.pem"):
        tls_context(tmp_path / "absent.pem", tmp_path / "absent.pem")


def test_too_many_connections_are_refused(monkeypatch):
    monkeypatch.setattr(server_module, "MAX_CLIENTS", 2)
    sentence = r"\(503\): .*maximum of 2 connections"
    with serving(StandIn()) as server, connect(server), connect(server):  # noqa: SIM117
        with pytest.raises(ServerGone, match=sentence):
            connect(server)


def test_encrypted_servers_use_modern_protocols(tmp_path):
    certificate = trustme.CA().issue_cert("127.0.0.1")
    certificate.private_key_and_cert_chain_pem.write_to_path(str(tmp_path / "server.pem"))
    context = tls_context(tmp_path / "server.pem", tmp_path / "server.pem")
    assert context.minimum_version >= ssl.TLSVersion.TLSv1_2
    assert context.num_tickets == 0
