"""Ask a policy server for actions, from a robot or a script.

    with PolicyClient("ws://127.0.0.1:8000") as policy:
        policy.reset()
        reply = policy.infer({"image": {"side": ..., "wrist": ...}, "state": ..., "prompt": "..."})
        reply["actions"]  # [C, J+1]

Needs only NumPy, msgpack and websockets, and Pillow for JPEG. Works with openpi's servers too.
"""

import asyncio
import os
import ssl
import threading
import time
from collections.abc import Callable, Coroutine, Mapping
from typing import Any, Self, TypeVar

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, InvalidURI, WebSocketException

from lorasp_jax.extras.serving import wire

T = TypeVar("T")
RETRY_EVERY = 0.2
"""Time between attempts to connect [s]."""


class PolicyError(RuntimeError):
    """The server refused a request or failed; the message is the server's sentence."""


class ServerGone(ConnectionError):
    """There is no server, it closed the connection, or it did not reply in time."""


def _may_pass(error: Exception) -> bool:
    """Whether what prevents a connection may end by itself, for example while a server starts."""
    if isinstance(error, InvalidStatus):
        return error.response.status_code in (502, 503, 504)
    return not isinstance(error, ssl.SSLError | InvalidURI)


class PolicyClient:
    """A connection to a policy server. Not thread-safe, but for `close`.

    The connection lives in a thread of its own, which answers the server's pings between requests.
    Only that thread touches it, since Python's encrypted sockets do not tolerate two.

    Attributes:
        address: the server's.
        metadata: the server's description of its policy.
    """

    def __init__(
        self,
        address: str = "ws://127.0.0.1:8000",
        *,
        token: str = "",
        timeout: float = 10.0,
        wait: float = 0.0,
        jpeg: int | None = None,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Connect to a server.

        Args:
            address: ws://host:port, or wss://host:port of a proxy whose certificate the system
                trusts.
            token: the server's token, if it requires one.
            timeout: how long to wait for the connection and for each reply [s].
            wait: how long to try again if there is no server yet, its name is not known yet, or it
                or a proxy says that it is not ready (502, 503, 504) [s].
            jpeg: quality, 1 to 100, of pictures that are sent as JPEG; None: as they are.
            say: told why it waits, once for each reason.

        Raises:
            ValueError: the quality is out of range, or the server does not read JPEG.
            ServerGone: there is no server at this address, it requires another token, or its
                certificate is not trusted.
        """
        if jpeg is not None and not 1 <= jpeg <= 100:
            raise ValueError(f"the quality of JPEG must be 1 to 100, got {jpeg}")
        self.address: str = address
        self._jpeg = jpeg
        self._timeout, self._reset = timeout, False
        self._closing = threading.Lock()
        self._options: dict[str, Any] = {
            "additional_headers": {"Authorization": f"Api-Key {token}"} if token else {},
            "compression": None,
            "max_size": wire.MAX_FRAME,
            "open_timeout": timeout,
            "close_timeout": 1,
            "proxy": None,
        }
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self._socket: ClientConnection | None = None
        try:
            self._socket = self._run(self._connect(wait, say))
            self.metadata: dict[str, Any] = self._exchange(None, timeout)
            encodings = self.metadata.get("encodings")
            if jpeg is not None and not (isinstance(encodings, list) and "jpeg" in encodings):
                raise ValueError(f"{address} does not read JPEG: send pictures as they are")
        except BaseException:
            self.close()
            raise

    def infer(
        self, observation: Mapping[str, Any], *, timeout: float | None = None
    ) -> dict[str, Any]:
        """Return the server's reply: `actions` `[C, J+1]` f32, and timings [ms].

        Args:
            observation: one of the server's request forms; may have the key `adapter`.
            timeout: how long to wait for the reply [s]; None is the client's default.

        Raises:
            PolicyError: the server refused the observation, after which it closes the connection,
                or its reply is malformed.
            ServerGone: the connection is lost, or no reply came in time. The connection is closed,
                since a late reply could be mistaken for the next one.
            ValueError: a picture that is to be sent as JPEG is none.
            TypeError: the observation contains something else than numbers, text and arrays.
        """
        if self._jpeg is not None:
            from lorasp_jax.extras.serving.jpeg import compress

            observation = compress(observation, self._jpeg)
        frame = wire.pack({**observation, "reset": True} if self._reset else observation)
        try:
            reply = self._exchange(frame, self._timeout if timeout is None else timeout)
        except BaseException:  # also after Ctrl-C, as the reply may still come
            self.close()
            raise
        self._reset = False
        return reply

    def reset(self) -> None:
        """Tell the server with the next request that a new episode starts."""
        self._reset = True

    def close(self) -> None:
        """Close the connection and stop its thread."""
        with self._closing:  # a call that this ends closes the connection, too
            if not self._thread.is_alive():
                return
            if self._socket is not None:
                self._run(self._socket.close())
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
            self._loop.close()

    def __enter__(self) -> Self:
        """Return the client."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connection."""
        self.close()

    def _run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine in the connection's thread."""
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result()

    async def _connect(self, wait: float, say: Callable[[str], None]) -> ClientConnection:
        """Connect, trying again for some time where the reason for a refusal may pass."""
        end, said = time.monotonic() + wait, ""
        while True:
            try:
                return await connect(self.address, **self._options)
            except (OSError, WebSocketException) as error:
                problem = self._problem(error)
                if time.monotonic() > end or not _may_pass(error):
                    raise ServerGone(problem) from error
                if problem != said:
                    say(f"{problem}; trying again for up to {end - time.monotonic():.0f} s")
                said = problem
                await asyncio.sleep(RETRY_EVERY)

    def _problem(self, error: Exception) -> str:
        """Say why there is no connection."""
        if isinstance(error, InvalidStatus):
            code, body = error.response.status_code, error.response.body or b""
            text = " ".join(body.decode(errors="replace").split())[:200]
            return f"{self.address} refused the connection ({code}): {text}"
        if isinstance(error, ssl.SSLCertVerificationError):
            file = os.environ.get("SSL_CERT_FILE", "")
            remedy = f"SSL_CERT_FILE names {file}, which does not exist"
            if not file or os.path.exists(file):
                remedy = "let SSL_CERT_FILE name a file with the certificate of its authority"
            reason = error.verify_message
            return f"the certificate of {self.address} is not trusted ({reason}): {remedy}"
        if isinstance(error, ssl.SSLError):
            return f"{self.address} does not encrypt ({error.strerror}): it may be for ws://"
        return f"no policy server at {self.address}: {str(error) or type(error).__name__}"

    def _exchange(self, frame: bytes | None, timeout: float) -> dict[str, Any]:
        """Send a frame, unless it is None, and return the next reply."""
        if not self._thread.is_alive():
            raise ServerGone(f"the connection to {self.address} is closed")
        try:
            reply = self._run(self._send_and_receive(frame, timeout))
        except TimeoutError as error:
            raise ServerGone(f"{self.address} did not reply within {timeout:g} s") from error
        except ConnectionClosed as error:
            reason = error.rcvd.reason if error.rcvd else ""
            text = f"{self.address} closed the connection{reason and ': '}{reason}"
            raise ServerGone(text) from error
        if isinstance(reply, str):
            raise PolicyError(reply)
        try:
            message = wire.unpack(reply)
        except wire.FrameError as error:
            raise PolicyError(f"the server's reply is malformed: {error}") from error
        if not isinstance(message, dict):
            raise PolicyError(f"the server's reply must be a map, got a {type(message).__name__}")
        return message

    async def _send_and_receive(self, frame: bytes | None, timeout: float) -> bytes | str:
        assert self._socket is not None
        async with asyncio.timeout(timeout):
            if frame is not None:
                await self._socket.send(frame)
            return await self._socket.recv()
