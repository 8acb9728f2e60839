"""Processes of a run connect, agree and exit together; here they are threads of one process."""

import contextlib
import queue
import re
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import ClassVar

import pytest

from lorasp_jax.training.distributed import peers, rendezvous
from lorasp_jax.training.distributed.rendezvous import Rendezvous
from tests.several import free_address

HINT = "to resume: add --resume"


class Process(peers.Peers):
    """A process that records how it would exit."""

    created: ClassVar[list] = []

    def __init__(self, address, number, count=2):
        self.printed, self.exits = [], queue.SimpleQueue()
        self.created.append(self)
        super().__init__(address, number, count, self.printed.append, HINT, retry_interval=0.05)

    def _stop(self, code, reason):
        self._code = self._code or code
        self.exits.put((self._code, reason))
        self.die()

    def die(self):
        """Close the connection, as SIGKILL does."""
        with contextlib.suppress(OSError):  # already closed
            self._socket.shutdown(socket.SHUT_RDWR)

    def exited(self):
        """The exit code and the printed reason."""
        return self.exits.get(timeout=60)


@pytest.fixture(autouse=True)
def _short_grace(monkeypatch):
    monkeypatch.setattr(rendezvous, "EXIT_GRACE", 0.2)
    yield
    while Process.created:
        Process.created.pop().die()


def connect(numbers=(0, 1), count=None):
    """Start a rendezvous and connect the processes with these numbers."""
    address, count = free_address(), count or len(numbers)
    Rendezvous(peers.listen(address), address, count, HINT)
    return [Process(address, number, count) for number in numbers]


def agree(processes, *facts, topic="settings"):
    """The error message of each process; None where all agree."""
    with ThreadPoolExecutor() as pool:
        futures = [
            pool.submit(process.agree, topic, values)
            for process, values in zip(processes, facts, strict=True)
        ]
        return [error and str(error) for error in (future.exception(30) for future in futures)]


def test_processes_agree_on_equal_facts_and_all_report_a_difference():
    three = connect((0, 1, 2))
    same = {"seed": 0, "peft": {"rank": 8, "method": "LoRA"}, "tasks": ["press"]}
    for topic in ("versions", "settings"):
        assert agree(three, same, same, same, topic=topic) == [None] * 3
    other = same | {"seed": 5, "peft": {"rank": 8}}
    reasons = agree(three, same, same, other, topic="base models")
    assert len({*reasons}) == 1
    assert reasons[0].startswith("process 2 on ")
    assert "base models that differ from those of the first process" in reasons[0]
    assert "(peft.method is None, not 'LoRA'; seed is 5, not 0): use the same" in reasons[0]


def test_long_lists_of_differences_are_truncated():
    facts = [{f"field{i}": f"{i}{who}" for i in range(9)} for who in "ab"]
    assert " and 4 more): use" in agree(connect(), *facts)[0]


@pytest.fixture
def impatient(monkeypatch):
    """Give up after two seconds; where all processes join, they have as long as they need."""
    monkeypatch.setattr(rendezvous, "JOIN_TIMEOUT", 2.0)


def test_missing_processes_are_listed(impatient):
    first, third = connect((0, 2), count=4)
    reasons = agree([first, third], {}, {})
    assert "2 of 4 processes joined at 127.0.0.1:" in reasons[0]
    assert "check that every missing process (1, 3) is running" in reasons[0]
    assert reasons[0] == reasons[1]


@pytest.mark.parametrize(
    ("numbers", "counts", "reason"),
    [
        ((0, 1, 1), (3, 3, 3), r"process 1 on \S+ has the same number as process 1 on \S+: number"),
        ((0, 1), (2, 3), r"process 1 on \S+ expects 3 processes, but the first process expects 2"),
    ],
)
def test_an_invalid_number_or_count_is_reported_by_all(numbers, counts, reason):
    address = free_address()
    Rendezvous(peers.listen(address), address, counts[0], HINT)
    pairs = zip(numbers, counts, strict=True)
    reasons = agree([Process(address, *pair) for pair in pairs], *[{} for _ in numbers])
    assert len({*reasons}) == 1
    assert re.search(reason, reasons[0])


def test_foreign_connections_are_ignored():
    address = free_address()
    Rendezvous(peers.listen(address), address, 2, HINT)
    for content in (b"GET / HTTP/1.1\r\n\r\n", b"[1, 2]\n", b'{"process": "x"}\n', b"x" * 2**21):
        foreign = socket.create_connection(peers.split_address(address))
        with foreign, contextlib.suppress(OSError):  # the server need not read all of it
            foreign.sendall(content)
    assert agree([Process(address, 0), Process(address, 1)], {}, {}) == [None, None]


def test_only_the_first_process_reports_the_death_of_another():
    first, second, third = connect((0, 1, 2))
    assert agree([first, second, third], {}, {}, {}) == [None] * 3
    second.die()
    assert third.exited() == (1, "")
    code, reason = first.exited()
    assert code == 1
    assert reason.startswith("process 1 on ")
    assert "disconnected unexpectedly: it was killed, or its machine" in reason
    assert reason.endswith(HINT)


def test_every_process_reports_the_death_of_the_first():
    listener = socket.create_server(("127.0.0.1", 0))
    address = f"127.0.0.1:{listener.getsockname()[1]}"

    def first():
        connection, _ = listener.accept()
        connection.sendall(rendezvous.encode(rendezvous.GREETING))
        connection.close()

    threading.Thread(target=first).start()
    code, reason = Process(address, 1).exited()
    listener.close()
    assert code == 1
    assert reason.startswith(f"the first process, at {address}, disconnected unexpectedly")
    assert reason.endswith(HINT)


def announce_exit(process, code, reason=""):
    process.exit_reason = reason
    threading.Thread(target=process.announce_exit, args=(code,), daemon=True).start()


def test_the_first_process_reports_the_error_of_another():
    first, second = connect()
    announce_exit(second, 2, "error: there is no such file")
    assert second.exited() == (2, "")
    code, reason = first.exited()
    assert code == 2
    assert reason.endswith(": error: there is no such file")


def test_the_first_process_reports_its_own_error(monkeypatch):
    monkeypatch.setattr(rendezvous, "EXIT_GRACE", 2.0)
    receive, received = Rendezvous._receive, threading.Event()

    def noticed(*arguments):
        receive(*arguments)
        received.set()

    monkeypatch.setattr(Rendezvous, "_receive", noticed)
    first, second, third = connect((0, 1, 2))
    announce_exit(first, 2, "error: the folder holds a run")
    assert received.wait(60)  # the first reason received counts
    announce_exit(third, 130, "stopped")
    assert [one.exited() for one in (second, third, first)] == [(2, ""), (130, ""), (2, "")]


def test_processes_that_have_finished_may_disconnect():
    first, second = connect()
    second.announce_exit(0)
    second.die()
    first.announce_exit(0)
    assert first.exits.empty()
    announce_exit(first, 2)
    assert first.exited() == (2, "")


def test_an_address_needs_a_port():
    for wrong in ("localhost", ":1234", "10.0.0.1:", "host:port", "host:70000", "host:0"):
        with pytest.raises(ValueError, match=r"must be host:port, such as .* got '"):
            peers.split_address(wrong)
    assert peers.split_address("[::1]:1234") == ("::1", 1234)


def test_a_port_in_use_is_reported():
    address = free_address()
    with (
        peers.listen(address),
        pytest.raises(ValueError, match=r"is not available \(Address already"),
    ):
        peers.listen(address)


def test_an_unreachable_address_is_reported(impatient):
    printed = []
    with pytest.raises(
        ValueError, match=r"process 1 could not reach the first process at .*refused\)"
    ):
        peers.Peers(free_address(), 1, 2, printed.append, HINT, notice_after=0.2)
    assert len(printed) == 1
    assert "process 1 is waiting for the first process at 127.0.0.1:" in printed[0]


def test_a_foreign_server_at_the_address_is_reported(monkeypatch):
    monkeypatch.setattr(rendezvous, "JOIN_TIMEOUT", 0.0)
    with socket.create_server(("127.0.0.1", 0)) as other:
        address = f"127.0.0.1:{other.getsockname()[1]}"

        def answer():
            connection, _ = other.accept()
            with connection:
                connection.sendall(b"SSH-2.0\r\n")

        threading.Thread(target=answer, daemon=True).start()
        with pytest.raises(ValueError, match=r"another program is listening there, or"):
            peers.Peers(address, 1, 2, print, HINT)
