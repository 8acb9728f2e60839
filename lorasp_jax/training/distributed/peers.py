"""A process's connection to the others of its run, see `meeting`."""

import contextlib
import json
import os
import platform
import queue
import socket
import threading
import time
from collections.abc import Callable, Mapping
from typing import IO, Any

from lorasp_jax.training.distributed import meeting

_TRY_EVERY, _ANSWER = 0.5, 5.0  # s
_SILENCE = 3.0  # s without a connection after which that is said
_PAUSE = 0.5  # s


class Peers:
    """The other processes, as this one knows them.

    Attributes:
        number: this one's.
        last_words: why it ends, if it does.
    """

    def __init__(
        self, address: str, number: int, count: int, say: Callable[[str], None], advice: str
    ) -> None:
        """Join them.

        Args:
            address: host:port where they meet.
            number: this process's, of `count`.
            say: prints a line.
            advice: what to do when the others are gone.

        Raises:
            ValueError: the address cannot be reached.
        """
        self.number: int = number
        self._address, self._say, self._advice = address, say, advice
        self._answers: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self.last_words: str = ""
        self._code = None
        self._socket, self._lines = _connected(address, number, say)
        self._send({"process": number, "of": count, "host": platform.node()})
        self._listening = threading.Thread(target=self._listen, daemon=True)
        self._listening.start()

    def agree(self, topic: str, facts: Mapping[str, Any]) -> None:
        """Wait until all have said the same.

        Args:
            topic: what the facts are, in the plural.
            facts: JSON values by name; values may be such mappings again.

        Raises:
            ValueError: another process says something else, or the run was refused before.
        """
        self._send({"topic": topic, "facts": flat(facts)})
        answer = self._answers.get()
        if answer["refused"]:
            raise ValueError(answer["refused"])

    def give_way(self) -> None:
        """Let the end of another process, which may be why this one fails, be heard first."""
        time.sleep(_PAUSE)

    def leave(self, code: int) -> None:
        """Tell the others that this process ends; unless the code is 0, wait for them to end."""
        self._code = code
        self._send({"leaving": code, "reason": self.last_words})
        if code:
            self._listening.join(2 * meeting.GRACE)

    def _listen(self) -> None:
        """Hear the others until the end, which is this process's, too."""
        # Cut off in the midst of a line, the connection is as lost as otherwise.
        with self._socket, self._lines, contextlib.suppress(OSError, ValueError):
            for line in self._lines:
                message = json.loads(line)
                if "leave" in message:
                    self._stop(message["leave"], message["say"])
                self._answers.put(message)
        if self._code is None:
            lost = f"the first process, at {self._address}, is gone without a word"
            why = "it was killed, or its machine or network failed"
            self._stop(1, f"{lost}: {why}; {self._advice}")

    def _stop(self, code: int, reason: str) -> None:
        """End this process, whatever its other threads are doing."""
        if reason:
            self._say(reason)
        os._exit(self._code or code)

    def _send(self, message: dict[str, Any]) -> None:
        with contextlib.suppress(OSError):  # the listener hears of it
            self._socket.sendall(meeting.encode(message))


def flat(facts: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with dotted names."""
    found: dict[str, Any] = {}
    for name, value in facts.items():
        nested = isinstance(value, Mapping)
        found |= flat(value, f"{prefix}{name}.") if nested else {f"{prefix}{name}": value}
    return found


def split_address(address: str) -> tuple[str, int]:
    """Host and port.

    Raises:
        ValueError: it is not HOST:PORT.
    """
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise ValueError(
            f"JAX_COORDINATOR_ADDRESS must be host:port, such as 10.0.0.1:1234, got {address!r}"
        )
    return host.strip("[]"), int(port)


def listen(address: str) -> socket.socket:
    """Listen at an address of this host.

    Raises:
        ValueError: its port cannot be had.
    """
    _, port = split_address(address)
    dual = socket.has_dualstack_ipv6()
    family = socket.AF_INET6 if dual else socket.AF_INET
    try:
        return socket.create_server(("", port), family=family, dualstack_ipv6=dual)
    except OSError as error:
        raise ValueError(
            f"port {port} of {platform.node()} cannot be had ({error.strerror}): choose "
            "another one in JAX_COORDINATOR_ADDRESS or, under Slurm, in JAX_COORDINATOR_PORT"
        ) from error


def _connected(
    address: str, number: int, say: Callable[[str], None]
) -> tuple[socket.socket, IO[bytes]]:
    """A connection to where the first process waits, or will, and the lines that come from there.

    Raises:
        ValueError: nobody answers there, or somebody else.
    """
    began, told = time.monotonic(), False
    while True:
        try:
            return _greeted(*split_address(address))
        except OSError as error:
            reason = error.strerror or str(error)
        waited = time.monotonic() - began
        if waited > meeting.PATIENCE:
            raise ValueError(
                f"process {number} found no first process at {address} in {meeting.PATIENCE:.0f} "
                f"s ({reason}): see that it was started, and that this is its address"
            )
        if waited > _SILENCE and not told:
            say(f"process {number} waits for the first one at {address} ({reason})")
            told = True
        time.sleep(_TRY_EVERY)


def _greeted(host: str, port: int) -> tuple[socket.socket, IO[bytes]]:
    """A connection to a run's first process.

    Raises:
        OSError: there is none.
    """
    connection = socket.create_connection((host, port), timeout=_ANSWER)
    with contextlib.ExitStack() as stack:
        stack.enter_context(connection)
        lines = stack.enter_context(connection.makefile("rb"))
        try:
            greeting = json.loads(lines.readline(meeting.LONGEST))
        except ValueError:
            greeting = None
        if greeting != meeting.GREETING:
            raise OSError("what answers is no run, or one that has begun")
        connection.settimeout(None)
        meeting.keep_alive(connection)
        stack.pop_all()  # stays open
    return connection, lines
