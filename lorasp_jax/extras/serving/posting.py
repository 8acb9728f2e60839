"""HTTP's POST on the port of the websocket server, whose library answers only GET.

A POST with a body is handed to the library as a GET without one, and `Connection.body` holds the
body; `process_request` then sees which it was.
"""

import asyncio
import http
import json
import logging
import re
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any

from websockets.asyncio.server import ServerConnection

from lorasp_jax.base import errors

if TYPE_CHECKING:  # which imports JAX
    from lorasp_jax.extras.serving.served import ServedPolicies

MAX_HEAD, MAX_BODY = 2**14, 2**16
"""Largest head and body of a POST [bytes]."""
PATIENCE, WAIT = 4.0, 5.0
"""How long a body may take after its head, and how long a POST waits for an adapter to load, which
then goes on without it [s]; a connection that has no answer after 10 s is closed."""
_log = logging.getLogger(__name__)
_LENGTH = re.compile(rb"\r\ncontent-length:[ \t]*(\d{1,9})[ \t]*(?=\r\n)", re.IGNORECASE)
_ENCODING = re.compile(rb"\r\ntransfer-encoding:[^\r\n]*(?=\r\n)", re.IGNORECASE)
Answer = tuple[http.HTTPStatus, str]
"""Status and text of a response."""


class Connection(ServerConnection):
    """A connection that may begin with a POST.

    Attributes:
        body: of a POST, at most `MAX_BODY` bytes; None for other requests.
        refusal: why the body was not read to its end, if so.
    """

    body: bytes | None = None
    refusal: Answer | None = None
    _received: bytes | None = b""
    _timer: asyncio.TimerHandle | None = None

    def data_received(self, data: bytes) -> None:
        """Collect a POST; pass on everything else."""
        if self.body is not None:
            return  # what follows a POST is ignored, as the connection closes after it
        if self._received is None:
            super().data_received(data)
            return
        self._received += data
        if not b"POST ".startswith(self._received[:5]):
            data, self._received = self._received, None
            super().data_received(data)
            return
        head, end, body = self._received.partition(b"\r\n\r\n")
        length = _LENGTH.search(head + b"\r\n")
        size = int(length[1]) if length else 0
        if (not end and len(head) <= MAX_HEAD) or (end and len(body) < size <= MAX_BODY):
            if end and not self._timer:
                self._timer = self.loop.call_later(PATIENCE, self._give_up)
            return  # more is to come
        if not length:
            self.refusal = http.HTTPStatus.LENGTH_REQUIRED, "send Content-Length, not chunks\n"
        self._pass_on(head, body[:size] if size <= MAX_BODY else b"")

    def _give_up(self) -> None:
        """Answer a POST whose body has not come."""
        if self._received is not None and not self.transport.is_closing():
            text = f"the body did not come within {PATIENCE:g} s\n"
            self.refusal = http.HTTPStatus.REQUEST_TIMEOUT, text
            self._pass_on(self._received.partition(b"\r\n\r\n")[0], b"")

    def _pass_on(self, head: bytes, body: bytes) -> None:
        """Hand a POST to the library, without what it refuses to read."""
        if self._timer:
            self._timer.cancel()
        self._received, self.body = None, body
        head = _ENCODING.sub(b"", _LENGTH.sub(b"", head + b"\r\n")).removeprefix(b"POST ")
        super().data_received(b"GET " + head + b"\r\n")


async def _in_daemon(call: Callable[[], None]) -> None:
    """Call a function in a thread that does not keep the process alive."""
    future: Future[None] = Future()
    future.set_running_or_notify_cancel()  # nobody cancels it

    def run() -> None:
        try:
            future.set_result(call())
        except BaseException as error:  # for who awaits it
            future.set_exception(error)

    threading.Thread(target=run, name="adapter", daemon=True).start()
    await asyncio.wrap_future(future)


class Adapters:
    """Loads and unloads adapters as POST /adapters says."""

    def __init__(self, policy: "ServedPolicies") -> None:
        """Change the adapters of `policy`."""
        self._policy = policy
        self._loading: set[asyncio.Task[http.HTTPStatus]] = set()
        self._last = ""

    @property
    def is_loading(self) -> bool:
        """Whether an adapter is being loaded or unloaded."""
        return bool(self._loading)

    def listed(self) -> str:
        """Return the adapters as JSON, and how the last change ended."""
        adapters = [{"name": n, "instructions": t} for n, t in self._policy.instructions.items()]
        return json.dumps({"adapters": adapters, **self.state()}) + "\n"

    def state(self) -> dict[str, Any]:
        """Return how many changes are under way, and how the last ended."""
        return {"loading": len(self._loading), "last": self._last}

    async def change(self, body: bytes) -> Answer:
        """Do what a body says; return the status of the response and a sentence."""
        try:
            call, said = self._parse(body)
        except ValueError as error:
            return http.HTTPStatus.BAD_REQUEST, f"{error}\n"
        if self._loading:  # a thread each would leave none to read requests
            return http.HTTPStatus.CONFLICT, "another adapter is loading: try again later\n"
        task = asyncio.create_task(self._run(call, said))
        self._loading.add(task)
        task.add_done_callback(self._loading.discard)
        await asyncio.wait([task], timeout=WAIT)
        if not task.done():
            return http.HTTPStatus.ACCEPTED, "still loading: GET /adapters says when it is done\n"
        return task.result(), f"{self._last}\n"

    async def _run(self, call: Callable[[], None], said: str) -> http.HTTPStatus:
        """Change the adapters in another thread, and remember how it ended."""
        try:
            await _in_daemon(call)
        except Exception as error:
            if reason := errors.describe(error):
                self._last = reason
                return http.HTTPStatus.BAD_REQUEST
            # A bug must not show the client a traceback.
            _log.exception("an adapter was not loaded")
            self._last = f"the server failed: {type(error).__name__}"
            return http.HTTPStatus.INTERNAL_SERVER_ERROR
        self._last = said
        return http.HTTPStatus.OK

    def _parse(self, body: bytes) -> tuple[Callable[[], None], str]:
        """Return what to call, and what to say afterwards."""
        try:
            values: Any = json.loads(body)
        except (ValueError, RecursionError):
            values = None
        values = values if isinstance(values, dict) else {}
        name, path, remove = (values.get(key) for key in ("name", "path", "remove"))
        known = values.keys() <= {"name", "path", "remove"}
        if known and isinstance(name, str) and isinstance(path, str) and not remove:
            return (lambda: self._policy.put(name, path)), f"{name} answers from {path}"
        if known and isinstance(name, str) and path is None and remove is True:
            return (lambda: self._policy.remove(name)), f"{name} is unloaded"
        raise ValueError(
            'the body must be JSON of at most 64 kB: {"name": NAME, "path": FOLDER} or '
            '{"name": NAME, "remove": true}'
        )
