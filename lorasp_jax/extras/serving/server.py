"""The policy server: openpi's websocket protocol, with pages of health and status on the same port.

A connection begins with a frame of metadata from the server. Then each request frame gets one reply
frame. An error is one sentence in a text frame, after which the server closes the connection with
code 1011, as openpi's servers do (src/openpi/serving/websocket_policy_server.py at 15a9616).
"""

import asyncio
import contextlib
import dataclasses
import hmac
import http
import ipaddress
import itertools
import logging
import socket
import time
import types
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request as HttpRequest
from websockets.http11 import Response

import lorasp_jax
from lorasp_jax.extras.serving import metrics, posting, watching, wire
from lorasp_jax.extras.serving.batching import Batcher, PolicyFailure
from lorasp_jax.extras.serving.requests import MAX_VALUES, Request, parse

if TYPE_CHECKING:  # which imports JAX
    from lorasp_jax.extras.serving.served import ServedPolicies

MAX_CLIENTS = 64
"""Maximum number of connections, unless given."""
SERVER = f"lorasp_jax {lorasp_jax.__version__}"
"""What this server calls itself."""
_MOST_WARNINGS = 20  # keys come from outside
_log = logging.getLogger(__name__)


@dataclass
class ClientState:
    """What the server remembers of one connection.

    Attributes:
        number: of the connection.
        seen: what the page shows of it.
        requests: requests on this connection.
        previous: the last chunk of the episode, f32 `[C, J+1]`.
        previous_ms: time from receiving the previous request to having sent its reply.
    """

    number: int
    seen: watching.Seen
    requests: int = 0
    previous: np.ndarray | None = field(default=None, repr=False)
    previous_ms: float | None = None

    def advance(self, request: Request) -> tuple[Request, tuple[int, int]]:
        """Return the request with the previous chunk, and its index as in `ServedPolicies.prepare`.

        Raises:
            ValueError: it should continue a chunk, but is the first of its episode.
        """
        if request.reset:
            self.previous = None
        if request.executed is not None and self.previous is None:
            raise ValueError("the first request of an episode must not have the key executed")
        index = self.number, self.requests
        self.requests += 1
        return dataclasses.replace(request, previous=self.previous), index


class PolicyServer:
    """Serves one policy to several clients.

    Attributes:
        counts: numbers of connections, open connections, requests, errors and batches.
    """

    def __init__(
        self,
        policy: "ServedPolicies",
        *,
        token: str = "",
        max_clients: int = MAX_CLIENTS,
        about: Mapping[str, str] = types.MappingProxyType({}),
    ) -> None:
        """Start the policy's thread; `listen` opens the port.

        Args:
            policy: already compiled.
            token: if not empty, clients must send it in the header "Authorization: Api-Key TOKEN".
            max_clients: maximum number of connections.
            about: shown on the page, such as where the policy is from.
        """
        names = ("connections", "open_connections", "refused_connections", "requests", "errors")
        self._max_clients, self._seconds = max_clients, metrics.Histogram()
        self._ranks = metrics.Histogram(metrics.RANKS)
        self.counts: Counter[str] = Counter(dict.fromkeys(names, 0))
        self._policy, self._token = policy, token
        self._batcher = Batcher(policy, self.counts)
        self._adapters = posting.Adapters(policy)
        self._watch = watching.Watch(policy, about)
        self._clients, self._warned = itertools.count(), set[str]()

    @contextlib.asynccontextmanager
    async def listen(self, port: socket.socket) -> AsyncIterator[Server]:
        """Accept connections on a port from `bind` while the context is open."""
        async with serve(
            self._handle,
            sock=port,
            origins=[None],  # browsers send their page's origin: no page may use a local server
            process_request=self._process_request,
            compression=None,
            max_size=wire.MAX_FRAME,
            max_queue=1,
            close_timeout=2,
            create_connection=posting.Connection,
        ) as server:
            yield server

    def problem(self) -> str | None:
        """Say why the policy does not answer; None if it does, or has nothing to answer."""
        return self._batcher.problem()

    def close(self, timeout: float | None = None) -> bool:
        """Stop the policy's thread; return False if it does not answer in time [s], or loads."""
        return self._batcher.close(timeout) and not self._adapters.is_loading

    def _process_request(
        self, connection: ServerConnection, request: HttpRequest
    ) -> Response | Awaitable[Response] | None:
        """Answer pages, and refuse connections without the token or beyond the limit."""
        assert isinstance(connection, posting.Connection)
        posted = connection.body
        if posted is not None and request.path != "/adapters":
            text = "POST is for /adapters\n"
            return connection.respond(http.HTTPStatus.METHOD_NOT_ALLOWED, text)
        if request.path == "/healthz":
            problem = self.problem()
            status = http.HTTPStatus.SERVICE_UNAVAILABLE if problem else http.HTTPStatus.OK
            return connection.respond(status, f"{problem or 'OK'}\n")
        if refusal := self._refusal(request):
            self.counts["refused_connections"] += 1
            _log.info("refused %s: %s", _peer(connection), refusal[1])
            response = connection.respond(refusal[0], f"{refusal[1]}\n")
            if refusal[0] is http.HTTPStatus.UNAUTHORIZED and watching.is_watched(request):
                response.headers["WWW-Authenticate"] = watching.CHALLENGE
            return response
        if watching.is_watched(request):
            return self._watched(request.path)
        if request.path == "/metrics":
            histograms = {"request_seconds": self._seconds, "batch_seconds": self._batcher.seconds}
            histograms["active_rank"] = self._ranks
            text = metrics.text(self.counts, histograms, self._policy.instructions)
            page = connection.respond(http.HTTPStatus.OK, text)
            del page.headers["Content-Type"]
            page.headers["Content-Type"] = metrics.CONTENT_TYPE
            return page
        if request.path == "/adapters":
            refused = connection.refusal
            return connection.respond(*refused) if refused else self._change(connection, posted)
        return None

    def _refusal(self, request: HttpRequest) -> tuple[http.HTTPStatus, str] | None:
        """Return why a page or a connection is refused; None if it is not."""
        headers = request.headers.get_all("Authorization")
        if len(headers) > 1:
            return http.HTTPStatus.BAD_REQUEST, "there must be one header Authorization"
        watched = watching.is_watched(request)
        given = watching.password("".join(headers)) if watched else "".join(headers)
        given = given.removeprefix("Api-Key ")
        if self._token and not hmac.compare_digest(given.encode(), self._token.encode()):
            text = "this server requires a token: Authorization: Api-Key TOKEN"
            return http.HTTPStatus.UNAUTHORIZED, text
        is_page = watched or request.path in ("/metrics", "/adapters")
        if is_page and not self._token and not watching.is_local(request):
            text = "without a token, this page is only at localhost, 127.0.0.1 or another address"
            return http.HTTPStatus.FORBIDDEN, text
        if not is_page and self.counts["open_connections"] >= self._max_clients:
            text = f"this server has its maximum of {self._max_clients} connections"
            return http.HTTPStatus.SERVICE_UNAVAILABLE, text
        return None

    async def _watched(self, path: str) -> Response:
        """Answer a page for people, or what it shows."""
        if path == "/":
            return watching.page()
        if path != "/status":
            return watching.picture(await asyncio.to_thread(self._watch.picture, path))
        waiting, running = self._batcher.load()
        more = {"problem": self.problem(), "waiting": waiting, "running": running}
        more |= {"max_clients": self._max_clients, "server": SERVER, **self._adapters.state()}
        return watching.json_page(self._watch.status(**self.counts, **more))

    async def _change(self, connection: ServerConnection, body: bytes | None) -> Response:
        """Answer a GET or POST of /adapters."""
        if body is None:
            return connection.respond(http.HTTPStatus.OK, self._adapters.listed())
        if not self._token:
            text = "adapters are changed only with a token: start the server with --token-file\n"
            return connection.respond(http.HTTPStatus.FORBIDDEN, text)
        return connection.respond(*await self._adapters.change(body))

    async def _handle(self, connection: ServerConnection) -> None:
        """Serve one connection until it closes."""
        client = ClientState(next(self._clients), watching.Seen(_peer(connection)))
        self._watch.clients[client.number] = client.seen
        self.counts.update(("connections", "open_connections"))
        _log.info("client %d connected from %s", client.number, client.seen.address)
        try:
            await connection.send(wire.pack(describe(self._policy)))
            async for frame in connection:
                await self._answer(connection, client, frame)
        except ConnectionClosed:
            pass  # the client has gone, which ends its episode
        except (ValueError, PolicyFailure) as error:
            await self._refuse(connection, client, str(error))
        except Exception as error:  # a bug must not show the client a traceback
            _log.exception("a request failed")
            await self._refuse(connection, client, f"the server failed: {type(error).__name__}")
        finally:
            self.counts["open_connections"] -= 1
            del self._watch.clients[client.number]
            _log.info("client %d left after %d requests", client.number, client.requests)

    async def _answer(
        self, connection: ServerConnection, client: ClientState, frame: bytes | str
    ) -> None:
        """Reply to one frame; raise ValueError or PolicyFailure if it has no answer."""
        start = time.perf_counter()
        if isinstance(frame, str):
            raise wire.FrameError("a request must be a binary frame")
        adapter, row, actions = await asyncio.to_thread(self._read, client, frame)
        chunk, policy_ms, rank = await self._batcher.infer(client.number, adapter, row)
        client.previous = chunk
        timing = {"infer_ms": (time.perf_counter() - start) * 1e3}
        if client.previous_ms is not None:
            timing["prev_total_ms"] = client.previous_ms
        reply = {
            "actions": chunk[:, :actions],
            "policy_timing": {"infer_ms": policy_ms},
            "server_timing": timing,
        }
        if rank is not None:
            reply["active_rank"] = client.seen.active_rank = rank
            self._ranks.observe(str(adapter), rank)
        await connection.send(wire.pack(reply))
        client.previous_ms = (time.perf_counter() - start) * 1e3
        self._seconds.observe(str(adapter), client.previous_ms / 1e3)
        self._watch.answered(client.seen, client.previous_ms)
        self.counts["requests"] += 1

    def _read(self, client: ClientState, frame: bytes) -> tuple[Any, Any, int | None]:
        """Return the adapter, the row and the number of action dimensions."""
        request = parse(wire.unpack(frame, max_values=MAX_VALUES), self._policy.spec)
        self._warn(request.unknown)
        adapter = self._policy.route(request)
        row = self._policy.prepare(adapter, *client.advance(request))
        client.seen.keep(str(adapter), request)
        return adapter, row, request.actions

    def _warn(self, keys: Iterable[str]) -> None:
        """Tell the log once of a key that has no meaning, such as a misspelt one."""
        for key in keys:
            if key not in self._warned and len(self._warned) < _MOST_WARNINGS:
                self._warned.add(key)
                _log.warning("requests have the key %.40r, which has no meaning", key)

    async def _refuse(
        self, connection: ServerConnection, client: ClientState, sentence: str
    ) -> None:
        """Send the client one sentence and close the connection."""
        self.counts["errors"] += 1
        _log.info("client %d is refused: %s", client.number, sentence)
        with contextlib.suppress(ConnectionClosed):
            await connection.send(sentence)
            await connection.close(CloseCode.INTERNAL_ERROR, "the previous frame says why")


def _peer(connection: ServerConnection) -> str:
    """Return the other end's address; a client that has gone has none."""
    host, port = (connection.remote_address or ("nowhere", 0))[:2]
    return f"{host} port {port}"


def describe(policy: "ServedPolicies") -> dict[str, Any]:
    """Return the metadata that clients receive first."""
    spec = policy.spec
    return {
        "server": SERVER,
        "cameras": list(spec.cameras),
        "image_size": spec.image_size,
        "encodings": ["raw", "jpeg"],
        "action_dim": spec.action_length,
        "action_horizon": spec.chunk,
        "adapters": list(policy.instructions),
        "instructions": {name: list(texts) for name, texts in policy.instructions.items()},
        "execution": spec.execution,
        "denoise_steps": policy.denoise_steps,
        "route": policy.routing,
        **policy.metadata,
    }


def bind(host: str, port: int, *, token: str = "") -> socket.socket:
    """Reserve a port without accepting connections yet; port 0 chooses a free one.

    Raises:
        ValueError: the port is taken or invalid, the host is not an address of this machine, or
            other machines could connect without a token.
    """
    if not 0 <= port < 2**16:
        raise ValueError(f"the port must be 0 to 65535, got {port}")
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        if not token and not ipaddress.ip_address(address[0]).is_loopback:
            raise ValueError(
                f"anyone who reaches {host} could use the policy: pass a token file, or listen on "
                "127.0.0.1"
            )
        with contextlib.ExitStack() as stack:
            reserved = stack.enter_context(socket.socket(family, socket.SOCK_STREAM))
            reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            reserved.bind(address)
            stack.pop_all()  # it stays open
            return reserved
    except OSError as error:
        raise ValueError(f"cannot listen on {host}, port {port}: {error.strerror}") from error
