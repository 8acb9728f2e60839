"""Where the processes of a run meet: in a thread of the first one, at the run's address.

JAX's own service is silent while somebody is missing, lets each process have other options, and
hears of a death after 100 s. So all meet here first, then it takes over the address; the
connections stay open, and one that closes says at once that a process is gone.

Messages are lines of JSON. What a process says, and what it is told:

    {"process": 1, "of": 2, "host": "name"}      {"lorasp_jax": 1}
    {"topic": "settings", "facts": {...}}        {"topic": "settings", "refused": why, or ""}
    {"leaving": exit code, "reason": why}        {"leave": exit code, "say": why, or ""}
"""

import asyncio
import json
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

GREETING = {"lorasp_jax": 1}
LONGEST = 2**20
"""Bytes of a message."""
PATIENCE = 180.0
"""Seconds that others are waited for, since the last one came."""
GRACE = 5.0
"""Seconds that the others have to end by themselves when one has left."""
_FAREWELL = 3.0  # s that the first one, and JAX's service with it, stays for the others to go
_NAMED = 5  # differences in a sentence
# A machine that is gone closes no connection: after 30 s of silence it is asked 3 times in 30 s.
_KEEPALIVE = {"TCP_KEEPIDLE": 30, "TCP_KEEPINTVL": 10, "TCP_KEEPCNT": 3}


def encode(message: dict[str, Any]) -> bytes:
    """A message as a line."""
    return json.dumps(message).encode() + b"\n"


def keep_alive(connection: socket.socket) -> None:
    """Have a connection close when the other machine is gone, within a minute."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _KEEPALIVE.items():
        if hasattr(socket, name):  # these are not Python's on every system
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


@dataclass
class _Member:
    """A process that has come.

    Attributes:
        facts: what it told and was not answered yet, by topic.
        left: the exit code and the reason that it gave.
        closed: whether its connection is.
    """

    number: int
    host: str
    writer: asyncio.StreamWriter
    facts: dict[str, dict[str, Any]] = field(default_factory=dict)
    left: tuple[int, str] | None = None
    closed: bool = False

    def __str__(self) -> str:
        return f"process {self.number} on {self.host}"

    def tell(self, message: dict[str, Any]) -> None:
        """Send a message, unless nobody is there."""
        if not self.closed:
            self.writer.write(encode(message))


class Meeting:
    """All processes of a run, as long as it lasts."""

    def __init__(self, listener: socket.socket, address: str, count: int, advice: str) -> None:
        """Meet in a thread of this process.

        Args:
            listener: listens at the address.
            address: as the others know it.
            count: processes that are to come, this one among them.
            advice: what to do when one of them is gone.
        """
        self._listener, self._address, self._count = listener, address, count
        self._advice, self._refused = advice, ""
        self._members: list[_Member] = []
        self._end: tuple[int, str] | None = None
        threading.Thread(target=asyncio.run, args=(self._run(),), daemon=True).start()

    async def _run(self) -> None:
        """From the first greeting to the last farewell."""
        self._changed = asyncio.Event()
        server = await asyncio.start_server(self._talk, sock=self._listener, limit=LONGEST)
        everyone = {*range(self._count)}
        present = lambda: {member.number for member in self._members}  # noqa: E731
        settled = lambda: self._end or self._refused or present() == everyone  # noqa: E731
        if not await self._until(settled, PATIENCE):
            missing = ", ".join(str(number) for number in sorted(everyone - present()))
            self._refuse(
                f"{len(present())} of {self._count} processes came to {self._address}, and nobody "
                f"else for {PATIENCE:.0f} s: see that process {missing} was started and can reach "
                "this address"
            )
        server.close()  # JAX's service is the next to listen here
        self._answer()
        over = lambda: all(member.closed for member in self._members)  # noqa: E731
        await self._until(lambda: self._end or over())
        if self._end:
            await self._dissolve(*self._end)
        await self._until(over)

    async def _until(self, holds: Callable[[], Any], seconds: float | None = None) -> bool:
        """Wait until a condition holds; False: it does not, and nothing changed for so long."""
        while not holds():
            self._changed.clear()
            try:
                await asyncio.wait_for(self._changed.wait(), seconds)
            except TimeoutError:
                return False
        return True

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Everything with one process, until its connection closes."""
        keep_alive(writer.get_extra_info("socket"))
        writer.write(encode(GREETING))
        try:
            member = self._welcome(json.loads(await reader.readline()), writer)
        except (ValueError, LookupError, TypeError, OSError):
            writer.close()  # somebody else
            return
        try:
            while line := await reader.readline():
                self._hear(member, json.loads(line))
        except (ValueError, OSError):
            pass  # cut off in the midst of a line, it is as gone as otherwise
        member.closed = True
        writer.close()
        if member.left is None:
            gone = "is gone without a word: it was killed, or its machine or network failed"
            self._end = self._end or (1, f"{member} {gone}; {self._advice}")
        self._changed.set()

    def _welcome(self, hello: dict[str, Any], writer: asyncio.StreamWriter) -> _Member:
        """A new member; one that cannot be is a reason for all to stop."""
        member = _Member(int(hello["process"]), str(hello["host"]), writer)
        if hello["of"] != self._count:
            self._refuse(f"{member} is one of {hello['of']}, but the first one of {self._count}")
        for other in self._members:
            if other.number == member.number:
                self._refuse(f"{member} has the number of {other}: each needs its own, from 0 on")
        self._members.append(member)
        self._changed.set()
        return member

    def _hear(self, member: _Member, message: dict[str, Any]) -> None:
        """What a member says."""
        if "topic" in message:
            member.facts[message["topic"]] = message["facts"]
            self._answer()
        else:
            code, reason = member.left = message["leaving"], message["reason"]
            if code:
                self._end = self._end or (code, f"{member}: {reason}")
        self._changed.set()

    def _refuse(self, reason: str) -> None:
        """Let nobody go on, for the first reason that is given."""
        self._refused = self._refused or reason
        self._changed.set()

    def _answer(self) -> None:
        """Compare what all have told by now; whoever waits hears if this run is refused."""
        for topic in {topic for member in self._members for topic in member.facts}:
            told = [member for member in self._members if topic in member.facts]
            if len(told) < self._count and not self._refused:
                continue
            first = next((member for member in told if member.number == 0), told[0])
            for member in told:
                self._refused = self._refused or _differences(first, member, topic)
            for member in told:
                del member.facts[topic]
                member.tell({"topic": topic, "refused": self._refused})

    async def _dissolve(self, code: int, reason: str) -> None:
        """All leave because one has, the first one last."""
        lost = lambda: any(m.closed and not m.left for m in self._members)  # noqa: E731
        left = lambda: all(m.left for m in self._members)  # noqa: E731
        await self._until(lambda: left() or lost(), GRACE)
        others = [member for member in self._members if member.number]
        for member in others:
            member.tell({"leave": code, "say": ""})
        await self._until(lambda: all(member.closed for member in others), _FAREWELL)
        for member in self._members:
            if member.number == 0:  # it has said itself why it leaves, if it does
                said = member.left is not None and member.left[0] != 0
                member.tell({"leave": code, "say": "" if said else reason})


def _differences(first: _Member, other: _Member, topic: str) -> str:
    """How what another process told differs from what the first one did; "" if it does not."""
    a, b = first.facts[topic], other.facts[topic]
    found = [
        f"{name} is {b.get(name)!r}, not {a.get(name)!r}"
        for name in sorted({*a, *b})
        if a.get(name) != b.get(name)
    ]
    if not found:
        return ""
    more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
    return (
        f"{other} has other {topic} than the first one ({'; '.join(found[:_NAMED])}{more}): start "
        "all processes alike"
    )
