"""Client side of `rendezvous`: connects a process to the server in the first process."""

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

from lorasp_jax.training.distributed import rendezvous

_CONNECT_TIMEOUT = 5.0  # s
_ROOT_CAUSE_DELAY = 0.5  # s


class Peers:
    """The other processes of the run, as seen from this one.

    Attributes:
        number: index of this process.
        exit_reason: why this process exits, reported to the others.
    """

    def __init__(
        self,
        address: str,
        number: int,
        count: int,
        say: Callable[[str], None],
        hint: str,
        *,
        retry_interval: float = 0.5,
        notice_after: float = 3.0,
    ) -> None:
        """Connect to the first process.

        Args:
            address: host:port of the rendezvous.
            number: index of this process, 0 to `count` - 1.
            count: number of processes.
            say: prints a line.
            hint: remedy printed if the connection is lost.
            retry_interval: time between attempts to connect [s].
            notice_after: time without a connection before a notice is printed [s].

        Raises:
            ValueError: the address cannot be reached.
        """
        self.number: int = number
        self._address, self._say, self._hint = address, say, hint
        self._answers: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self.exit_reason: str = ""
        self._code = None
        self._socket, self._lines = _connect(address, number, say, retry_interval, notice_after)
        self._send({"process": number, "of": count, "host": platform.node()})
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def agree(self, topic: str, facts: Mapping[str, Any]) -> None:
        """Wait until all processes have reported their facts, which must be equal.

        Args:
            topic: plural noun for the facts, used in messages.
            facts: JSON values by name, possibly in nested mappings.

        Raises:
            ValueError: the facts of another process differ, or the run was rejected earlier.
        """
        self._send({"topic": topic, "facts": flatten(facts)})
        answer = self._answers.get()
        if answer["refused"]:
            raise ValueError(answer["refused"])

    def wait_for_root_cause(self) -> None:
        """Wait briefly, to let a process that failed earlier report the cause."""
        time.sleep(_ROOT_CAUSE_DELAY)

    def announce_exit(self, code: int) -> None:
        """Announce that this process is exiting; unless `code` is 0, wait to be told to exit."""
        self._code = code
        self._send({"leaving": code, "reason": self.exit_reason})
        if code:
            self._listener.join(2 * rendezvous.EXIT_GRACE)

    def _listen(self) -> None:
        """Receive messages until the run ends, then exit this process."""
        # A partial line means that the connection is lost.
        with self._socket, self._lines, contextlib.suppress(OSError, ValueError):
            for line in self._lines:
                message = json.loads(line)
                if "leave" in message:
                    self._stop(message["leave"], message["say"])
                self._answers.put(message)
        if self._code is None:
            lost = f"the first process, at {self._address}, disconnected unexpectedly"
            cause = "it was killed, or its machine or network failed"
            self._stop(1, f"{lost}: {cause}; {self._hint}")

    def _stop(self, code: int, reason: str) -> None:
        """Print `reason` and exit without waiting for other threads."""
        if reason:
            self._say(reason)
        os._exit(self._code or code)

    def _send(self, message: dict[str, Any]) -> None:
        with contextlib.suppress(OSError):  # the listener thread notices a lost connection
            self._socket.sendall(rendezvous.encode(message))


def flatten(facts: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested mappings into one with dotted names."""
    flat: dict[str, Any] = {}
    for name, value in facts.items():
        nested = isinstance(value, Mapping)
        flat |= flatten(value, f"{prefix}{name}.") if nested else {f"{prefix}{name}": value}
    return flat


def split_address(address: str) -> tuple[str, int]:
    """Split an address into host and port.

    Raises:
        ValueError: the address is not HOST:PORT.
    """
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise ValueError(
            f"JAX_COORDINATOR_ADDRESS must be host:port, such as 10.0.0.1:1234, got {address!r}"
        )
    return host.strip("[]"), int(port)


def listen(address: str) -> socket.socket:
    """Listen on the port of `address`, which is an address of this host.

    Raises:
        ValueError: the port is not available.
    """
    _, port = split_address(address)
    dual = socket.has_dualstack_ipv6()
    family = socket.AF_INET6 if dual else socket.AF_INET
    try:
        return socket.create_server(("", port), family=family, dualstack_ipv6=dual)
    except OSError as error:
        raise ValueError(
            f"port {port} on {platform.node()} is not available ({error.strerror}): choose "
            "another one in JAX_COORDINATOR_ADDRESS or, under Slurm, in JAX_COORDINATOR_PORT"
        ) from error


def _connect(
    address: str,
    number: int,
    say: Callable[[str], None],
    retry_interval: float,
    notice_after: float,
) -> tuple[socket.socket, IO[bytes]]:
    """Connect to the first process, retrying until it is up; return the socket and a reader.

    Raises:
        ValueError: no run answers at the address.
    """
    start, notified = time.monotonic(), False
    while True:
        try:
            return _open_connection(*split_address(address))
        except OSError as error:
            reason = error.strerror or str(error)
        waited = time.monotonic() - start
        if waited > rendezvous.JOIN_TIMEOUT:
            raise ValueError(
                f"process {number} could not reach the first process at {address} within "
                f"{rendezvous.JOIN_TIMEOUT:.0f} s ({reason}): check that it is running and that "
                "this is its address"
            )
        if waited > notice_after and not notified:
            say(f"process {number} is waiting for the first process at {address} ({reason})")
            notified = True
        time.sleep(retry_interval)


def _open_connection(host: str, port: int) -> tuple[socket.socket, IO[bytes]]:
    """Connect to the first process of a run.

    Raises:
        OSError: no server answers, or the server is not that of a run waiting for processes.
    """
    connection = socket.create_connection((host, port), timeout=_CONNECT_TIMEOUT)
    with contextlib.ExitStack() as stack:
        stack.enter_context(connection)
        lines = stack.enter_context(connection.makefile("rb"))
        try:
            greeting = json.loads(lines.readline(rendezvous.MAX_MESSAGE_BYTES))
        except ValueError:
            greeting = None
        if greeting != rendezvous.GREETING:
            raise OSError("another program is listening there, or the run has already started")
        connection.settimeout(None)
        rendezvous.keep_alive(connection)
        stack.pop_all()  # keep the connection open
    return connection, lines
