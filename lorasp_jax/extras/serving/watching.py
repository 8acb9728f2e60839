"""The page at `/`: what a server does now, for people.

A request only leaves references behind; numbers are computed and pictures compressed when a browser
asks for them. With a token, a browser asks its user for it: the password of HTTP's Basic scheme,
with any name. That is for reading these pages alone, as browsers send a password that they know
with the requests of other sites' pages, too.
"""

import base64
import contextlib
import http
import ipaddress
import json
import math
import time
from collections import Counter, defaultdict, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np
from websockets.datastructures import Headers
from websockets.http11 import Request as HttpRequest
from websockets.http11 import Response

from lorasp_jax.extras.serving.requests import Request

if TYPE_CHECKING:  # which imports JAX
    from lorasp_jax.extras.serving.served import ServedPolicies

KEPT = 1000
"""Number of latest requests that percentiles are of."""
CHALLENGE = 'Basic realm="policy server, password: its token", charset="UTF-8"'
_RATE_TIME = 10.0  # s over which requests are counted
_QUALITY = 80  # of pictures
_PICTURES = "/pictures/"
_SAFE = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline'; style-src "
    "'unsafe-inline'; img-src 'self' data:; connect-src 'self'; frame-ancestors 'none'; "
    "base-uri 'none'; form-action 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


@dataclass
class Seen:
    """What the page shows of a client.

    Attributes:
        address: of its end of the connection.
        requests: number of answers.
        images: camera -> uint8 `[S, S, 3]`, of the last request.
        prompt: its instruction.
        adapter: its adapter's name.
        asked: when it came [s, monotonic].
        last_ms: time until the last answer was sent.
        active_rank: mean active rank of the last answer, if its adapter has an energy gate.
    """

    address: str
    requests: int = 0
    images: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)
    prompt: str = ""
    adapter: str = ""
    asked: float | None = None
    last_ms: float | None = None
    active_rank: float | None = None

    def keep(self, adapter: str, request: Request) -> None:
        """Remember a request."""
        self.images, self.prompt, self.adapter = request.images, request.prompt or "", adapter
        self.asked, self.active_rank = time.monotonic(), None


class Watch:
    """What the page shows.

    Attributes:
        clients: by the number of their connections.
    """

    def __init__(self, policy: "ServedPolicies", about: Mapping[str, str]) -> None:
        """Begin to watch; `about` is shown as it is."""
        self._policy, self._about, self._start = policy, dict(about), time.monotonic()
        self._latest: deque[tuple[float, str, float]] = deque(maxlen=KEPT)
        self._requests: Counter[str] = Counter()
        self.clients: dict[int, Seen] = {}

    def answered(self, client: Seen, milliseconds: float) -> None:
        """Count an answer."""
        client.requests += 1
        client.last_ms = milliseconds
        self._requests[client.adapter] += 1
        self._latest.append((time.monotonic(), client.adapter, milliseconds))

    def status(self, **more: Any) -> str:
        """Return all that the page shows, with values that only the server has, as JSON."""
        now, by_adapter = time.monotonic(), defaultdict[str, list[float]](list)
        for _, adapter, milliseconds in self._latest:
            by_adapter[adapter].append(milliseconds)
        every = [x for values in by_adapter.values() for x in values]
        places = self._policy.places
        self._requests = Counter({name: self._requests[name] for name in places})
        robot = self._policy.metadata.get("robot")
        status = {
            **more,
            "about": self._about | ({"robot": robot} if robot else {}),
            "uptime_s": round(now - self._start, 1),
            "requests_per_s": round(self._rate(now), 2),
            "latency_ms": {"of": len(every), **_percentiles(every, 50, 95, 99)},
            "adapters": [
                {
                    "name": name,
                    "weights": place,
                    "requests": self._requests[name],
                    **_percentiles(by_adapter[name], 50, 95),
                }
                for name, place in places.items()
            ],
            "clients": [_describe(number, seen, now) for number, seen in self.clients.items()],
        }
        return json.dumps(status) + "\n"

    def _rate(self, now: float) -> float:
        """Return requests per second, of the last `_RATE_TIME` or as far as they are known."""
        times = [when for when, _, _ in self._latest if when > now - _RATE_TIME]
        whole = len(self._latest) < KEPT or self._latest[0][0] < now - _RATE_TIME
        since = max(self._start, now - _RATE_TIME) if whole else times[0]
        return len(times) / max(now - since, 1e-3)

    def picture(self, path: str) -> bytes | None:
        """Return the last picture of a client's camera as JPEG; None if there is none."""
        number, _, camera = path.removeprefix(_PICTURES).partition("?")[0].partition("/")
        seen = self.clients.get(int(number)) if number.isdecimal() and len(number) < 20 else None
        image = seen.images.get(unquote(camera)) if seen else None
        if image is None:
            return None
        from lorasp_jax.extras.serving.jpeg import encode

        return encode(camera, image, _QUALITY)


def _describe(number: int, seen: Seen, now: float) -> dict[str, Any]:
    return {
        "number": number,
        "address": seen.address,
        "requests": seen.requests,
        "adapter": seen.adapter,
        "prompt": seen.prompt,
        "cameras": [*seen.images],
        "idle_s": None if seen.asked is None else round(now - seen.asked, 1),
        "last_ms": seen.last_ms,
        "active_rank": seen.active_rank,
    }


def _percentiles(values: Sequence[float], *percent: int) -> dict[str, float | None]:
    """Return nearest-rank percentiles as p50 and so on; None without values."""
    ordered = sorted(values)
    ranks = {p: max(0, math.ceil(p / 100 * len(ordered)) - 1) for p in percent}
    return {f"p{p}": round(ordered[i], 3) if ordered else None for p, i in ranks.items()}


def is_watched(request: HttpRequest) -> bool:
    """Whether a browser asks for the page, or for what it shows."""
    if request.path == "/":  # where clients connect, too
        return not request.headers.get_all("Upgrade")
    return request.path == "/status" or request.path.startswith(_PICTURES)


def password(header: str) -> str:
    """Return the password in a header of HTTP's Basic scheme, else the header."""
    scheme, _, text = header.partition(" ")
    if scheme.lower() != "basic":
        return header
    with contextlib.suppress(ValueError):  # also of base64 and of UTF-8
        return base64.b64decode(text, validate=True).decode().partition(":")[2]
    return ""


def is_local(request: HttpRequest) -> bool:
    """Whether a request's host is localhost or an address.

    Where nothing else protects a server, another site's page could else read it under a name of its
    own that it lets point to 127.0.0.1.
    """
    host = "".join(request.headers.get_all("Host")).lower()
    name = host[1:].partition("]")[0] if host[:1] == "[" else host.partition(":")[0]
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(name))
    return name == "localhost"


def page() -> Response:
    """Return the page."""
    body = Path(__file__).with_name("status.html").read_bytes()
    return _respond(body, "text/html; charset=utf-8")


def picture(jpeg: bytes | None) -> Response:
    """Return a picture, or say that there is none."""
    if jpeg is None:
        body = b"there is no such client, or it has sent no such picture\n"
        return _respond(body, "text/plain; charset=utf-8", http.HTTPStatus.NOT_FOUND)
    return _respond(jpeg, "image/jpeg")


def json_page(text: str) -> Response:
    """Return JSON."""
    return _respond(text.encode(), "application/json")


def _respond(body: bytes, kind: str, status: http.HTTPStatus = http.HTTPStatus.OK) -> Response:
    headers = Headers(_SAFE)
    headers["Content-Type"], headers["Content-Length"] = kind, str(len(body))
    headers["Connection"] = "close"
    return Response(status.value, status.phrase, headers, body)
