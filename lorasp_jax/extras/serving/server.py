"""The policy server: openpi's websocket protocol, with health and metrics pages on the same port.

A connection begins with a frame of metadata from the server. Then each request frame gets one reply
frame. An error is one sentence in a text frame, after which the server closes the connection with
code 1011, as openpi's servers do (src/openpi/serving/websocket_policy_server.py at 15a9616).
"""

import asyncio
import contextlib
import hmac
import http
import ipaddress
import itertools
import logging
import socket
import ssl
import time
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import Any

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request as HttpRequest
from websockets.http11 import Response

import lorasp_jax
from lorasp_jax.extras.serving import requests, wire
from lorasp_jax.extras.serving.batching import Batcher, BatchPolicy, PolicyFailure
from lorasp_jax.extras.serving.metrics import Metrics
from lorasp_jax.extras.serving.sessions import Session

MAX_CLIENTS = 64
"""Maximum number of connections."""
MAX_PORT = 65_535
_log = logging.getLogger(__name__)


class PolicyServer:
    """Serves one policy to several clients."""

    def __init__(
        self, policy: BatchPolicy, metadata: Mapping[str, Any] | None = None, *, token: str = ""
    ) -> None:
        """Start the policy's thread; `listen` opens the port.

        Args:
            policy: already compiled.
            metadata: more entries for the metadata frame.
            token: if not empty, clients must send it in the header "Authorization: Api-Key TOKEN".
        """
        self.metrics: Metrics = Metrics()
        self._policy, self._token = policy, token
        self._batcher = Batcher(policy, self.metrics, _log_failure)
        self._metadata = wire.pack(describe(policy) | dict(metadata or {}))
        self._clients = itertools.count()
        self._connections = 0

    @contextlib.asynccontextmanager
    async def listen(
        self, port: socket.socket, *, tls: ssl.SSLContext | None = None
    ) -> AsyncIterator[Server]:
        """Accept connections while the context is open.

        Args:
            port: from `bind`.
            tls: from `tls_context`, to encrypt the connections.

        Raises:
            ValueError: other machines could connect, but there is no token.
        """
        check_exposure(port, self._token)
        options: dict[str, Any] = {"compression": None, "max_size": wire.MAX_FRAME, "max_queue": 1}
        async with serve(
            self._handle,
            sock=port,
            ssl=tls,
            origins=[None],  # browsers send their page's origin: no page may use a local server
            process_request=self._process_request,
            close_timeout=2,
            **options,
        ) as server:
            yield server

    def close(self) -> None:
        """Stop the policy's thread."""
        self._batcher.close()

    def _process_request(
        self, connection: ServerConnection, request: HttpRequest
    ) -> Response | None:
        """Answer pages, and refuse connections without the token or beyond the limit."""
        if request.path == "/healthz":
            return connection.respond(http.HTTPStatus.OK, "OK\n")
        if not self._is_authorized(request):
            text = "this server requires a token: Authorization: Api-Key TOKEN\n"
            return connection.respond(http.HTTPStatus.UNAUTHORIZED, text)
        if request.path == "/metrics":
            return connection.respond(http.HTTPStatus.OK, self.metrics.page())
        if self._connections >= MAX_CLIENTS:
            text = f"this server has its maximum of {MAX_CLIENTS} connections\n"
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, text)
        return None

    def _is_authorized(self, request: HttpRequest) -> bool:
        if not self._token:
            return True
        given = request.headers.get("Authorization", "").removeprefix("Api-Key ")
        return hmac.compare_digest(given.encode(), self._token.encode())

    async def _handle(self, connection: ServerConnection) -> None:
        """Serve one connection until it closes."""
        session = Session(next(self._clients))
        self._connections += 1
        self.metrics.count("connections")
        self.metrics.count("open_connections")
        try:
            await connection.send(self._metadata)
            async for frame in connection:
                await self._answer(connection, session, frame)
        except ConnectionClosed:
            pass  # the client has gone, which ends its session
        except (ValueError, PolicyFailure) as error:
            await self._refuse(connection, str(error))
        except Exception as error:  # a bug must not show the client a traceback
            _log.exception("a request failed")
            await self._refuse(connection, f"the server failed: {type(error).__name__}")
        finally:
            self._connections -= 1
            self.metrics.count("open_connections", -1)

    async def _answer(
        self, connection: ServerConnection, session: Session, frame: bytes | str
    ) -> None:
        """Reply to one frame.

        Raises:
            ValueError, PolicyFailure: it has no answer.
        """
        start = time.perf_counter()
        if isinstance(frame, str):
            raise wire.FrameError("a request must be a binary frame")
        adapter, row, actions = await asyncio.to_thread(self._read, session, frame)
        answer = await self._batcher.infer(session.client, adapter, row)
        session.previous = answer.actions
        infer_ms = (time.perf_counter() - start) * 1e3
        timing = {"infer_ms": infer_ms}
        if session.previous_ms is not None:
            timing["prev_total_ms"] = session.previous_ms
        reply = {
            "actions": answer.actions[:, :actions],
            "policy_timing": {"infer_ms": answer.milliseconds},
            "server_timing": timing,
        }
        await connection.send(wire.pack(reply))
        session.previous_ms = (time.perf_counter() - start) * 1e3
        self.metrics.count("requests")
        self.metrics.observe("server infer", infer_ms)
        self.metrics.observe("server total", session.previous_ms)

    def _read(self, session: Session, frame: bytes) -> tuple[str, Any, int]:
        """Return the adapter's name, the row and the number of action dimensions."""
        request = requests.parse(wire.unpack(frame), self._policy.spec)
        adapter = request.adapter or self._policy.adapters[0]
        if adapter not in self._policy.adapters:
            known = ", ".join(self._policy.adapters)
            raise ValueError(f"adapter must be one of {known}, got {adapter!r}")
        row = self._policy.prepare(*session.advance(request))
        return adapter, row, request.actions

    async def _refuse(self, connection: ServerConnection, sentence: str) -> None:
        """Send the client one sentence and close the connection."""
        self.metrics.count("errors")
        with contextlib.suppress(ConnectionClosed):
            await connection.send(sentence)
            reason = "the previous frame says why"
            await connection.close(CloseCode.INTERNAL_ERROR, reason)


def describe(policy: BatchPolicy) -> dict[str, Any]:
    """Return the metadata that clients receive first."""
    spec = policy.spec
    return {
        "server": f"lorasp_jax {lorasp_jax.__version__}",
        "cameras": list(spec.cameras),
        "image_size": spec.image_size,
        "action_dim": spec.state_dim,
        "action_horizon": spec.chunk,
        "adapters": list(policy.adapters),
        "instructions": {name: list(texts) for name, texts in policy.instructions.items()},
        "execution": spec.execution,
    }


def bind(host: str, port: int) -> socket.socket:
    """Reserve a port without accepting connections yet; port 0 chooses a free one.

    Raises:
        ValueError: the port is taken or invalid, or the host is not an address of this machine.
    """
    if not 0 <= port <= MAX_PORT:
        raise ValueError(f"the port must be 0 to {MAX_PORT}, got {port}")
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        reserved = socket.socket(family, socket.SOCK_STREAM)
        try:
            reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            reserved.bind(address)
        except OSError:
            reserved.close()
            raise
    except OSError as error:
        raise ValueError(f"cannot listen on {host}, port {port}: {error.strerror}") from error
    return reserved


def check_exposure(port: socket.socket, token: str) -> None:
    """Raise ValueError if other machines could connect to a port without a token."""
    host = port.getsockname()[0]
    if not ipaddress.ip_address(host).is_loopback and not token:
        raise ValueError(
            f"anyone who reaches {host} could use the policy: pass a token file, or listen on "
            "127.0.0.1"
        )


def tls_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """Return the settings of an encrypted server.

    Args:
        certificate: PEM file of the certificate chain.
        key: PEM file of its private key.

    Raises:
        ValueError: a file is missing, or they do not belong together.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    # Session tickets arrive while clients send their first request. Clients that read and write in
    # two threads, such as openpi's, can then hang (github.com/python/cpython/issues/143756).
    context.num_tickets = 0
    try:
        context.load_cert_chain(certificate, key)
    except (OSError, ssl.SSLError) as error:
        raise ValueError(f"cannot use {certificate} with {key}: {error}") from error
    return context


def _log_failure(error: BaseException) -> None:
    _log.error("the policy failed", exc_info=error)
