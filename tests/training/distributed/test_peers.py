"""The processes of a run meet, agree, and hear of each other's end; here as threads of one."""

import contextlib
import queue
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import ClassVar

import pytest

from lorasp_jax.training.distributed import meeting, peers
from lorasp_jax.training.distributed.meeting import Meeting
from tests.several import free_address

ADVICE = "to go on: add --resume"


class Process(peers.Peers):
    """One that says how it ends in place of ending."""

    made: ClassVar[list] = []

    def __init__(self, address, number, count=2):
        self.said, self.end = [], queue.SimpleQueue()
        self.made.append(self)
        super().__init__(address, number, count, self.said.append, ADVICE)

    def _stop(self, code, reason):
        self._code = self._code or code
        self.end.put((self._code, reason))
        self.die()

    def die(self):
        """As SIGKILL closes its connection."""
        with contextlib.suppress(OSError):  # it has
            self._socket.shutdown(socket.SHUT_RDWR)

    def ended(self):
        return self.end.get(timeout=10)


@pytest.fixture(autouse=True)
def _soon(monkeypatch):
    monkeypatch.setattr(meeting, "PATIENCE", 1.0)
    monkeypatch.setattr(meeting, "GRACE", 0.2)
    monkeypatch.setattr(peers, "_TRY_EVERY", 0.05)
    yield
    while Process.made:
        Process.made.pop().die()


def meet(numbers=(0, 1), count=None):
    """The processes of these numbers."""
    address, count = free_address(), count or len(numbers)
    Meeting(peers.listen(address), address, count, ADVICE)
    return [Process(address, number, count) for number in numbers]


def agree(processes, *facts, topic="settings"):
    """What each is refused for; None: all agree."""
    with ThreadPoolExecutor() as pool:
        asked = [
            pool.submit(process.agree, topic, said)
            for process, said in zip(processes, facts, strict=True)
        ]
        return [error and str(error) for error in (one.exception(30) for one in asked)]


def test_equal_facts_are_agreed_on_and_a_difference_is_named_to_all():
    three = meet((0, 1, 2))
    same = {"seed": 0, "peft": {"rank": 8, "method": "LoRA"}, "tasks": ["press"]}
    for topic in ("versions", "settings"):
        assert agree(three, same, same, same, topic=topic) == [None] * 3
    other = same | {"seed": 5, "peft": {"rank": 8}}
    reasons = agree(three, same, same, other, topic="bases")
    assert len({*reasons}) == 1
    assert reasons[0].startswith("process 2 on ")
    assert "other bases than the first one" in reasons[0]
    assert "(peft.method is None, not 'LoRA'; seed is 5, not 0): start all" in reasons[0]


def test_many_differences_are_cut_short():
    facts = [{f"field{i}": f"{i}{who}" for i in range(9)} for who in "ab"]
    assert " and 4 more): start" in agree(meet(), *facts)[0]


def test_who_is_missing_is_said():
    first, third = meet((0, 2), count=4)
    reasons = agree([first, third], {}, {})
    assert "2 of 4 processes came to 127.0.0.1:" in reasons[0]
    assert "see that process 1, 3 was started" in reasons[0]
    assert reasons[0] == reasons[1]


@pytest.mark.parametrize(
    ("numbers", "counts", "reason"),
    [
        ((0, 1, 1), (3, 3, 3), r"process 1 on \S+ has the number of process 1 on \S+: each"),
        ((0, 1), (2, 3), r"process 1 on \S+ is one of 3, but the first one of 2"),
    ],
)
def test_a_wrong_number_is_everybodys_reason(numbers, counts, reason):
    address = free_address()
    Meeting(peers.listen(address), address, counts[0], ADVICE)
    pairs = zip(numbers, counts, strict=True)
    found = agree([Process(address, *pair) for pair in pairs], *[{} for _ in numbers])
    assert len({*found}) == 1
    with pytest.raises(ValueError, match=reason):
        raise ValueError(found[0])


def test_strangers_do_not_disturb():
    address = free_address()
    Meeting(peers.listen(address), address, 2, ADVICE)
    for words in (b"GET / HTTP/1.1\r\n\r\n", b"[1, 2]\n", b'{"process": "x"}\n', b"x" * 2**21):
        with socket.create_connection(peers.split_address(address)) as stranger:
            stranger.sendall(words)
    assert agree([Process(address, 0), Process(address, 1)], {}, {}) == [None, None]


def test_when_one_dies_the_first_says_so_and_the_others_are_quiet():
    first, second, third = meet((0, 1, 2))
    assert agree([first, second, third], {}, {}, {}) == [None] * 3
    second.die()
    assert third.ended() == (1, "")
    code, reason = first.ended()
    assert code == 1
    assert reason.startswith("process 1 on ")
    assert "is gone without a word: it was killed, or its machine" in reason
    assert reason.endswith(ADVICE)


def test_when_the_first_dies_every_other_one_says_so():
    listener = socket.create_server(("127.0.0.1", 0))
    address = f"127.0.0.1:{listener.getsockname()[1]}"

    def first():
        connection, _ = listener.accept()
        connection.sendall(meeting.encode(meeting.GREETING))
        connection.close()

    threading.Thread(target=first).start()
    code, reason = Process(address, 1).ended()
    listener.close()
    assert code == 1
    assert reason.startswith(f"the first process, at {address}, is gone without a word")
    assert reason.endswith(ADVICE)


def leave(process, code, reason=""):
    process.last_words = reason
    threading.Thread(target=process.leave, args=(code,), daemon=True).start()


def test_what_another_one_is_refused_for_is_said_by_the_first():
    first, second = meet()
    leave(second, 2, "error: there is no such file")
    assert second.ended() == (2, "")
    code, reason = first.ended()
    assert code == 2
    assert reason.endswith(": error: there is no such file")


def test_the_first_one_says_itself_why_it_leaves(monkeypatch):
    monkeypatch.setattr(meeting, "GRACE", 2.0)
    first, second, third = meet((0, 1, 2))
    leave(first, 2, "error: the folder holds a run")
    time.sleep(0.3)  # whoever is heard first says why
    leave(third, 130, "stopped")
    assert [one.ended() for one in (second, third, first)] == [(2, ""), (130, ""), (2, "")]


def test_who_has_finished_is_not_missed():
    first, second = meet()
    second.leave(0)
    second.die()
    first.leave(0)
    assert first.end.empty()
    leave(first, 2)
    assert first.ended() == (2, "")


def test_an_address_needs_a_port():
    for wrong in ("localhost", ":1234", "10.0.0.1:", "host:port", "host:70000", "host:0"):
        with pytest.raises(ValueError, match=r"must be host:port, such as .* got '"):
            peers.split_address(wrong)
    assert peers.split_address("[::1]:1234") == ("::1", 1234)


def test_a_port_in_use_is_said():
    address = free_address()
    with peers.listen(address), pytest.raises(ValueError, match=r"cannot be had \(Address already"):
        peers.listen(address)


def test_nobody_at_an_address_is_said(monkeypatch):
    monkeypatch.setattr(peers, "_SILENCE", 0.2)
    said = []
    with pytest.raises(ValueError, match=r"process 1 found no first process at .*refused\)"):
        peers.Peers(free_address(), 1, 2, said.append, ADVICE)
    assert len(said) == 1
    assert "process 1 waits for the first one at 127.0.0.1:" in said[0]


def test_somebody_else_at_an_address_is_said(monkeypatch):
    monkeypatch.setattr(meeting, "PATIENCE", 0.0)
    with socket.create_server(("127.0.0.1", 0)) as other:
        address = f"127.0.0.1:{other.getsockname()[1]}"

        def answer():
            connection, _ = other.accept()
            with connection:
                connection.sendall(b"SSH-2.0\r\n")

        threading.Thread(target=answer, daemon=True).start()
        with pytest.raises(ValueError, match=r"what answers is no run"):
            peers.Peers(address, 1, 2, print, ADVICE)
