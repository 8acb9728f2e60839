"""Test POST /adapters on the wire: what is in its way, and what it says then."""

import http.client
import json
import socket
import threading
import time

import pytest

from lorasp_jax.extras.serving import posting
from tests.extras.serving.adapter_runs import get, post
from tests.extras.serving.stand_in import StandIn, connect, observation, serving

PUT = {"name": "pour", "path": "runs/pour"}


class Loading(StandIn):
    """Loads an adapter once `may_load` is set, or raises `failure`."""

    def __init__(self):
        super().__init__()
        self.may_load, self.begun = threading.Event(), threading.Event()

    def put(self, name, path):
        self.begun.set()
        assert self.may_load.wait(60)
        if self.failure:
            raise self.failure
        self.instructions = self.instructions | {name: ()}

    def remove(self, name):
        self.instructions = {n: t for n, t in self.instructions.items() if n != name}


@pytest.fixture
def policy():
    policy = Loading()
    yield policy
    policy.may_load.set()


@pytest.fixture
def server(policy):
    with serving(policy, token="secret") as server:
        yield server


def raw(server, *parts):
    """Send parts of a request; return the status and the text of the answer."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=60) as connection:
        for part in parts:
            connection.sendall(part)
        answer = http.client.HTTPResponse(connection)
        answer.begin()
        return answer.status, answer.read().decode()


HEAD = b"POST /adapters HTTP/1.1\r\nHost: x\r\nAuthorization: Api-Key secret\r\n"


def test_one_adapter_loads_at_a_time(server, policy, monkeypatch):
    monkeypatch.setattr(posting, "WAIT", 0.05)
    assert post(server, PUT) == (202, "still loading: GET /adapters says when it is done\n")
    status, text = post(server, PUT | {"name": "open"})
    assert (status, "another adapter is loading" in text) == (409, True)
    assert json.loads(get(server, "/adapters")[1])["loading"] == 1
    policy.may_load.set()
    deadline = time.monotonic() + 60
    while json.loads(get(server, "/adapters")[1])["loading"] and time.monotonic() < deadline:
        time.sleep(0.01)
    assert json.loads(get(server, "/adapters")[1])["last"] == "pour answers from runs/pour"
    assert [*policy.instructions] == ["base", "pour"]


def test_closing_does_not_wait_for_an_adapter(server, policy, monkeypatch):
    monkeypatch.setattr(posting, "WAIT", 0.05)
    assert post(server, PUT)[0] == 202
    assert policy.begun.is_set()
    assert not server.close(1), "the thread that loads is still there"


@pytest.mark.parametrize(
    ("failure", "status", "sentence"),
    [
        (PermissionError(13, "Permission denied", "runs/pour"), 400, "runs/pour: Permission"),
        (ValueError("it is\nof another base"), 400, "it is of another base"),
        (RuntimeError("secret"), 500, "the server failed: RuntimeError"),
    ],
)
def test_what_fails_is_said_in_a_sentence(server, policy, failure, status, sentence):
    policy.failure = failure
    policy.may_load.set()
    found, text = post(server, PUT)
    assert (found, text.startswith(sentence), text.count("\n")) == (status, True, 1)
    assert "secret" not in text


def test_bodies_in_chunks_are_refused(server):
    body = b"1\r\n{\r\n0\r\n\r\n"
    status, text = raw(server, HEAD + b"Transfer-Encoding: chunked\r\n\r\n" + body)
    assert (status, "Content-Length" in text) == (411, True)
    assert raw(server, HEAD + b"\r\n")[0] == 411


def test_slow_bodies_are_answered(server, monkeypatch):
    monkeypatch.setattr(posting, "PATIENCE", 0.2)
    start = time.monotonic()
    status, text = raw(server, HEAD + b"Content-Length: 9\r\n\r\n{")
    assert (status, "within 0.2 s" in text) == (408, True)
    assert time.monotonic() - start > 0.15


def test_a_slow_client_needs_the_token_too(server, monkeypatch):
    monkeypatch.setattr(posting, "PATIENCE", 0.1)
    assert raw(server, HEAD.replace(b"secret", b"wrong") + b"Content-Length: 9\r\n\r\n")[0] == 401


def test_a_client_that_leaves_amid_its_body_is_forgotten(server, policy, monkeypatch, caplog):
    monkeypatch.setattr(posting, "PATIENCE", 0.1)
    with socket.create_connection(("127.0.0.1", server.port)) as connection:
        connection.sendall(HEAD + b"Content-Length: 9\r\n\r\n")
    time.sleep(0.3)
    with connect(server, token="secret") as client:
        client.infer(observation())
    assert "Error" not in caplog.text


def test_metrics_forget_an_adapter_that_was_unloaded(server, policy):
    policy.may_load.set()
    assert post(server, PUT)[0] == 200
    with connect(server, token="secret") as client:
        client.infer(observation(adapter="pour"))
        client.infer(observation())
    assert 'seconds_count{adapter="pour"} 1' in get(server, "/metrics")[1]
    assert post(server, {"name": "pour", "remove": True})[0] == 200
    page = get(server, "/metrics")[1]
    assert 'adapter="pour"' not in page
    assert 'request_seconds_count{adapter="base"} 1' in page
    assert 'batch_seconds_count{adapter="base"} 1' in page
