"""Rendezvous of a run's processes: a server thread in the first process, at the run's address.

JAX's own service prints nothing while processes are missing, does not compare their options, and
notices a dead process only after 100 s. All processes therefore meet here first; JAX's service then
takes over the address. The connections stay open, so that the death of a process is noticed at
once.

Messages are lines of JSON. A process sends the left column, the server the right one:

    {"process": 1, "of": 2, "host": "name"}      {"lorasp_jax": 1}
    {"topic": "settings", "facts": {...}}        {"topic": "settings", "refused": reason or ""}
    {"leaving": exit code, "reason": reason}     {"leave": exit code, "say": reason or ""}
"""

import asyncio
import json
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

GREETING = {"lorasp_jax": 1}
MAX_MESSAGE_BYTES = 2**20
JOIN_TIMEOUT = 180.0
"""Seconds to wait for missing processes, counted from the last one that joined."""
EXIT_GRACE = 5.0
"""Seconds that the other processes have to announce their own exit after one fails."""
_LAST_EXIT_GRACE = 3.0  # s; the first process exits last because it hosts JAX's service
_MAX_DIFFERENCES = 5  # per message
# A crashed machine leaves its connections open. After 30 s of silence, send 3 probes, 10 s apart.
_KEEPALIVE = {"TCP_KEEPIDLE": 30, "TCP_KEEPINTVL": 10, "TCP_KEEPCNT": 3}


def encode(message: dict[str, Any]) -> bytes:
    """Encode a message as one line."""
    return json.dumps(message).encode() + b"\n"


def keep_alive(connection: socket.socket) -> None:
    """Make a connection close within a minute if the other machine fails."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _KEEPALIVE.items():
        if hasattr(socket, name):  # not available on every system
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


@dataclass
class _Member:
    """A process that has joined.

    Attributes:
        facts: reported values by topic, until they are compared.
        exit: the exit code and reason it announced.
    """

    number: int
    host: str
    writer: asyncio.StreamWriter
    facts: dict[str, dict[str, Any]] = field(default_factory=dict)
    exit: tuple[int, str] | None = None
    closed: bool = False

    def __str__(self) -> str:
        return f"process {self.number} on {self.host}"

    def send(self, message: dict[str, Any]) -> None:
        if not self.closed:
            self.writer.write(encode(message))


class Rendezvous:
    """Server that all processes of a run stay connected to."""

    def __init__(self, listener: socket.socket, address: str, count: int, hint: str) -> None:
        """Serve in a thread of this process.

        Args:
            listener: socket that accepts the connections.
            address: host:port of the listener, for messages.
            count: number of processes, including this one.
            hint: remedy printed if a process dies.
        """
        self._listener, self._address, self._count = listener, address, count
        self._hint, self._rejection = hint, ""
        self._members: list[_Member] = []
        self._end: tuple[int, str] | None = None
        threading.Thread(target=asyncio.run, args=(self._run(),), daemon=True).start()

    async def _run(self) -> None:
        """Serve from the first connection until the last one closes."""
        self._changed = asyncio.Event()
        server = await asyncio.start_server(
            self._serve, sock=self._listener, limit=MAX_MESSAGE_BYTES
        )
        everyone = {*range(self._count)}
        present = lambda: {member.number for member in self._members}  # noqa: E731
        settled = lambda: self._end or self._rejection or present() == everyone  # noqa: E731
        if not await self._until(settled, JOIN_TIMEOUT):
            missing = ", ".join(str(number) for number in sorted(everyone - present()))
            self._reject(
                f"{len(present())} of {self._count} processes joined at {self._address}, but no "
                f"others joined within {JOIN_TIMEOUT:.0f} s: check that every missing process "
                f"({missing}) is running and can reach this address"
            )
        server.close()  # JAX's service listens here next
        self._answer()
        over = lambda: all(member.closed for member in self._members)  # noqa: E731
        await self._until(lambda: self._end or over())
        if self._end:
            await self._shut_down(*self._end)
        await self._until(over)

    async def _until(self, holds: Callable[[], Any], timeout: float | None = None) -> bool:
        """Wait until a condition holds; return False if nothing changes for `timeout` seconds."""
        while not holds():
            self._changed.clear()
            try:
                await asyncio.wait_for(self._changed.wait(), timeout)
            except TimeoutError:
                return False
        return True

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one process until its connection closes."""
        keep_alive(writer.get_extra_info("socket"))
        writer.write(encode(GREETING))
        try:
            member = self._join(json.loads(await reader.readline()), writer)
        except (ValueError, LookupError, TypeError, OSError):
            writer.close()  # not a process of a run
            return
        try:
            while line := await reader.readline():
                self._receive(member, json.loads(line))
        except (ValueError, OSError):
            pass  # a partial line means that the connection is lost
        member.closed = True
        writer.close()
        if member.exit is None:
            lost = "disconnected unexpectedly: it was killed, or its machine or network failed"
            self._end = self._end or (1, f"{member} {lost}; {self._hint}")
        self._changed.set()

    def _join(self, hello: dict[str, Any], writer: asyncio.StreamWriter) -> _Member:
        """Add a process; reject the run if the process's number is taken or its count differs."""
        member = _Member(int(hello["process"]), str(hello["host"]), writer)
        if hello["of"] != self._count:
            self._reject(
                f"{member} expects {hello['of']} processes, but the first process expects "
                f"{self._count}"
            )
        for other in self._members:
            if other.number == member.number:
                self._reject(
                    f"{member} has the same number as {other}: number the processes from 0"
                )
        self._members.append(member)
        self._changed.set()
        return member

    def _receive(self, member: _Member, message: dict[str, Any]) -> None:
        if "topic" in message:
            member.facts[message["topic"]] = message["facts"]
            self._answer()
        else:
            code, reason = member.exit = message["leaving"], message["reason"]
            if code:
                self._end = self._end or (code, f"{member}: {reason}")
        self._changed.set()

    def _reject(self, reason: str) -> None:
        """Reject the run; only the first reason is reported."""
        self._rejection = self._rejection or reason
        self._changed.set()

    def _answer(self) -> None:
        """Answer each topic that all processes have reported, or all topics of a rejected run."""
        for topic in {topic for member in self._members for topic in member.facts}:
            reporting = [member for member in self._members if topic in member.facts]
            if len(reporting) < self._count and not self._rejection:
                continue
            first = next((member for member in reporting if member.number == 0), reporting[0])
            for member in reporting:
                self._rejection = self._rejection or _differences(first, member, topic)
            for member in reporting:
                del member.facts[topic]
                member.send({"topic": topic, "refused": self._rejection})

    async def _shut_down(self, code: int, reason: str) -> None:
        """Make all processes exit because one failed; the first process exits last."""
        lost = lambda: any(m.closed and not m.exit for m in self._members)  # noqa: E731
        announced = lambda: all(m.exit for m in self._members)  # noqa: E731
        await self._until(lambda: announced() or lost(), EXIT_GRACE)
        others = [member for member in self._members if member.number]
        for member in others:
            member.send({"leave": code, "say": ""})
        await self._until(lambda: all(member.closed for member in others), _LAST_EXIT_GRACE)
        for member in self._members:
            if member.number == 0:  # if it failed itself, it has printed why
                failed = member.exit is not None and member.exit[0] != 0
                member.send({"leave": code, "say": "" if failed else reason})


def _differences(first: _Member, other: _Member, topic: str) -> str:
    """Describe how the facts of another process differ from the first one's; return "" if equal."""
    a, b = first.facts[topic], other.facts[topic]
    differences = [
        f"{name} is {b.get(name)!r}, not {a.get(name)!r}"
        for name in sorted({*a, *b})
        if a.get(name) != b.get(name)
    ]
    if not differences:
        return ""
    more = len(differences) - _MAX_DIFFERENCES
    rest = f" and {more} more" if more > 0 else ""
    return (
        f"{other} has {topic} that differ from those of the first process "
        f"({'; '.join(differences[:_MAX_DIFFERENCES])}{rest}): use the same ones in all processes"
    )
