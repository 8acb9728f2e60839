"""Test the page for people: what it is told, who may read it, and how a browser shows it."""

import base64
import contextlib
import html.parser
import io
import itertools
import json
import re
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect as raw_connect

from lorasp_jax.extras.serving import watching
from tests.extras.serving.browser import browser
from tests.extras.serving.stand_in import SPEC, StandIn, connect, observation, serving

ABOUT = {"from": "runs/press"}
PAGE = Path(watching.__file__).with_name("status.html")
NASTY = "<img src=x onerror=alert(1)>"


def fetch(server, path, **headers):
    """Return status, headers and body."""
    url = f"http://127.0.0.1:{server.port}{path}"
    try:
        reply = urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=60)
    except urllib.error.HTTPError as error:
        reply = error
    with reply:
        return reply.status, reply.headers, reply.read()


def status(server):
    return json.loads(fetch(server, "/status")[2])


def scheme(text):
    return {"Authorization": f"Basic {text}"}


def basic(password, name="anyone"):
    return scheme(base64.b64encode(f"{name}:{password}".encode()).decode())


@pytest.fixture(scope="module")
def server():
    policy = StandIn(adapters=("press", "pour"), metadata={"robot": "piper"})
    with serving(policy, about=ABOUT) as server:
        yield server


def test_status_says_what_the_server_does(server):
    before = status(server)["requests"]
    with connect(server) as first, connect(server) as second:
        for _ in range(3):
            first.infer(observation(prompt="press it"))
        assert second.infer(observation(adapter="pour", prompt="pour it"))
        said = status(server)
    assert said["requests"] == before + 4
    assert said["about"] == {**ABOUT, "robot": "piper"}
    assert said["latency_ms"]["of"] == said["requests"]
    assert 0 < said["latency_ms"]["p50"] <= said["latency_ms"]["p95"] <= said["latency_ms"]["p99"]
    assert said["requests_per_s"] > 0
    assert [(each["name"], each["weights"]) for each in said["adapters"]] == [
        ("press", "nowhere"),
        ("pour", "nowhere"),
    ]
    shown = [(each["requests"], each["adapter"], each["prompt"]) for each in said["clients"]]
    assert shown == [(3, "press", "press it"), (1, "pour", "pour it")]
    assert all(each["cameras"] == ["side", "wrist"] for each in said["clients"])
    deadline = time.monotonic() + 30
    while status(server)["clients"] and time.monotonic() < deadline:
        time.sleep(0.01)
    assert status(server)["clients"] == []  # those that have gone, and their pictures


def test_active_ranks_are_replied_and_shown():
    policy = StandIn()
    with serving(policy) as server, connect(server) as client:
        assert "active_rank" not in client.infer(observation())
        assert status(server)["clients"][0]["active_rank"] is None
        assert "active_rank_count" not in fetch(server, "/metrics")[2].decode()
        policy.ranks = np.float32([11.5, 7, 7, 7])
        assert client.infer(observation())["active_rank"] == 11.5
        assert status(server)["clients"][0]["active_rank"] == 11.5
        series = fetch(server, "/metrics")[2].decode().splitlines()
    assert 'lorasp_jax_active_rank_bucket{adapter="base",le="8.0"} 0' in series
    assert 'lorasp_jax_active_rank_bucket{adapter="base",le="16.0"} 1' in series
    assert 'lorasp_jax_active_rank_sum{adapter="base"} 11.500000' in series


def test_the_queue_is_what_waits_and_what_runs():
    policy = StandIn()
    policy.gate.clear()
    with serving(policy) as server, connect(server) as a, connect(server) as b:
        threads = [threading.Thread(target=x.infer, args=[observation()]) for x in (a, b)]
        threads[0].start()
        while not policy.batches:
            time.sleep(0.001)
        threads[1].start()
        while (said := status(server))["waiting"] == 0:
            time.sleep(0.001)
        assert (said["waiting"], said["running"]) == (1, 1)
        policy.gate.set()
        for thread in threads:
            thread.join()
        assert (status(server)["waiting"], status(server)["requests"]) == (0, 2)


def test_the_last_picture_of_each_camera(server):
    with connect(server) as client:
        number = status(server)["clients"][-1]["number"]
        assert fetch(server, f"/pictures/{number}/side")[0] == 404  # it has sent none yet
        for value in (10, 200):
            client.infer(observation(value=value))
        code, headers, body = fetch(server, f"/pictures/{number}/side?2")
        assert (code, headers["Content-Type"]) == (200, "image/jpeg")
        assert headers["Cache-Control"] == "no-store"
        picture = np.asarray(Image.open(io.BytesIO(body)))
        assert picture.shape == (SPEC.image_size, SPEC.image_size, 3)
        np.testing.assert_allclose(picture.astype(int), 200, atol=3)
        for wrong in (f"{number}/top", f"{number}", "999/side", "x/side", f"{'9' * 5000}/side", ""):
            assert fetch(server, f"/pictures/{wrong}")[0] == 404


def test_pictures_are_encoded_only_when_asked_for(server, monkeypatch):
    encoded = []
    monkeypatch.setattr(
        "lorasp_jax.extras.serving.jpeg.encode", lambda *a: encoded.append(a) or b""
    )
    with connect(server) as client:
        client.infer(observation())
        number = status(server)["clients"][-1]["number"]
        assert encoded == []
        fetch(server, f"/pictures/{number}/side")
        assert len(encoded) == 1


def test_pages_need_the_token_as_password():
    with serving(StandIn(), token="sécret: a") as server, connect(server, token="sécret: a"):
        for path in ("/", "/status", "/pictures/0/side"):
            for wrong in ({}, basic("wrong"), basic(""), *map(scheme, ("!", "ÿ", "/w=="))):
                code, headers, _ = fetch(server, path, **wrong)
                assert (code, headers["WWW-Authenticate"][:6]) == (401, "Basic ")
            expected = 404 if "pictures" in path else 200
            assert fetch(server, path, **basic("sécret: a"))[0] == expected


def test_a_password_that_browsers_know_changes_and_infers_nothing():
    """Browsers add it to requests that other sites' pages make, too."""
    with serving(StandIn(), token="secret") as server:
        for path in ("/adapters", "/metrics"):
            code, headers, _ = fetch(server, path, **basic("secret"))
            assert (code, headers["WWW-Authenticate"]) == (401, None)
        with pytest.raises(InvalidStatus, match="HTTP 401"):
            raw_connect(server.address, additional_headers=basic("secret"))


def test_without_a_token_no_foreign_name_reads_the_page(server):
    """A site may let its own name point to 127.0.0.1."""
    for path in ("/", "/status", "/pictures/0/side", "/adapters", "/metrics"):
        for foreign in (
            "evil.example",
            f"evil.example:{server.port}",
            "127.0.0.1.evil.example",
            "",
        ):
            code, _, body = fetch(server, path, Host=foreign)
            assert code == 403, foreign
            assert b"without a token" in body
    for own in ("localhost", f"LOCALHOST:{server.port}", "127.0.0.1", "[::1]:8000"):
        assert fetch(server, "/", Host=own)[0] == 200, own


def test_the_page_loads_nothing_from_elsewhere(server):
    code, headers, body = fetch(server, "/")
    assert (code, headers["Content-Type"]) == (200, "text/html; charset=utf-8")
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert body == PAGE.read_bytes()
    assert not re.search(r"https?:|//[a-z]|@import|url\(", body.decode().replace("// ", ""))


def test_the_page_is_well_formed_and_labelled():
    class Parser(html.parser.HTMLParser):
        open, found = [], {}

        def handle_starttag(self, tag, attrs):
            self.found.setdefault(tag, []).append(dict(attrs))
            if tag not in ("meta", "link", "input"):
                self.open.append(tag)

        def handle_endtag(self, tag):
            assert self.open.pop() == tag

    parser = Parser()
    parser.feed(PAGE.read_text())
    assert parser.open == []
    assert parser.found["html"] == [{"lang": "en"}]
    assert len(parser.found["h1"]) == len(parser.found["title"]) == 1
    assert all(each.get("scope") == "col" for each in parser.found["th"])


@pytest.fixture(scope="module")
def new_tab():
    with browser() as new_tab:
        yield new_tab


CONTRAST = """(() => {
  const lum = (c) => { const [r, g, b] = c.match(/\\d+/g).slice(0, 3).map((x) => x / 255)
    .map((x) => x <= .03928 ? x / 12.92 : ((x + .055) / 1.055) ** 2.4);
    return .2126 * r + .7152 * g + .0722 * b; };
  const ground = (n) => { for (; n; n = n.parentElement) { const c = getComputedStyle(n)
    .backgroundColor; if (!/, 0\\)/.test(c)) return c; } return "rgb(255, 255, 255)"; };
  return [...document.querySelectorAll("h1,h2,h3,p,th,td,dt,dd,span,figcaption,label")]
    .filter((n) => n.innerText.trim()).map((n) => { const [a, b] =
      [lum(getComputedStyle(n).color), lum(ground(n))].sort((x, y) => y - x);
      return [(a + .05) / (b + .05), n.tagName, n.innerText.slice(0, 30)]; })
    .reduce((x, y) => x[0] < y[0] ? x : y); })()"""


def test_a_browser_shows_it(server, new_tab):
    tab = new_tab()
    with connect(server) as client, connect(server) as other:
        client.infer(observation(value=200, prompt=NASTY))
        other.infer(observation(adapter="pour", prompt="pour " * 50))
        tab.open(f"http://127.0.0.1:{server.port}/")
        tab.wait("document.querySelectorAll('figure img').length == 4")
        tab.wait("[...document.images].every((i) => i.complete && i.naturalWidth == 16)")
        assert tab.run("document.getElementById('state').innerText") == "answering"
        text = tab.run("document.body.innerText")
        for shown in (NASTY, "pour", "from runs/press", "robot piper", "Client "):
            assert shown in text
        for width, dark in itertools.product((1000, 400), (False, True)):
            tab.look(width=width, dark=dark)
            assert tab.run("document.documentElement.scrollWidth") <= width
            table = "document.querySelector('.scroll')"  # all its columns are in sight
            assert tab.run(f"{table}.scrollWidth - {table}.clientWidth") == 0
            assert tab.run(CONTRAST)[0] >= 4.5, tab.run(CONTRAST)  # WCAG 2.1, level AA
            ground = tab.run("getComputedStyle(document.body).backgroundColor")
            assert (int(ground.split("(")[1].split(",")[0]) < 128) == dark
        first = "document.querySelector('figure img').src"
        before = tab.run(first)
        client.infer(observation(value=200, prompt=NASTY))
        tab.wait(f"{first} != {before!r}")
        tab.run("document.getElementById('show').click()")
        tab.wait("document.querySelectorAll('figure').length == 0")
    tab.wait("!document.getElementById('nobody').hidden")
    assert tab.problems == []


def test_a_browser_asks_for_the_password(new_tab):
    with serving(StandIn(), token="secret") as server, connect(server, token="secret") as client:
        client.infer(observation())
        tab = new_tab()
        tab.answer_password("secret")
        tab.open(f"http://127.0.0.1:{server.port}/")
        tab.wait("document.querySelectorAll('figure img').length == 2")
        tab.wait("[...document.images].every((i) => i.complete && i.naturalWidth == 16)")


def test_the_page_says_when_the_server_has_gone(new_tab):
    with contextlib.ExitStack() as stack:
        tab, server = new_tab(), stack.enter_context(serving(StandIn()))
        tab.open(f"http://127.0.0.1:{server.port}/")
        tab.wait("document.getElementById('state').innerText == 'answering'")
        stack.close()
        tab.wait("document.getElementById('state').innerText == 'no answer'")
        assert tab.run("document.getElementById('state').className") == "bad"


def test_rates_and_percentiles(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(watching.time, "monotonic", lambda: clock[0])
    policy = StandIn()
    watch, seen = watching.Watch(policy, {}), watching.Seen("here", adapter="base")
    for number in range(watching.KEPT + 500):  # 50 a second
        clock[0] += 0.02
        watch.answered(seen, number)
    said = json.loads(watch.status())
    assert said["requests_per_s"] == pytest.approx(50, rel=0.01)
    assert said["adapters"][0]["requests"] == watching.KEPT + 500
    expected = {"of": watching.KEPT, "p50": 999, "p95": 1449, "p99": 1489}
    assert said["latency_ms"] == expected
    clock[0] += 5
    assert json.loads(watch.status())["requests_per_s"] == pytest.approx(25, rel=0.01)
    for number in range(watching.KEPT):  # more than are kept, within the time
        clock[0] += 0.002
        watch.answered(seen, number)
    assert json.loads(watch.status())["requests_per_s"] == pytest.approx(500, rel=0.01)
    texts = policy.instructions.pop("base")
    assert json.loads(watch.status())["adapters"] == []
    policy.instructions["base"] = texts
    assert json.loads(watch.status())["adapters"][0]["requests"] == 0, "it is another adapter"
