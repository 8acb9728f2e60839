"""Locks between processes, released when a process ends."""

import fcntl
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from lorasp_jax.base import locks

HOLD = """
import os, pathlib, sys
from lorasp_jax.base import locks

with locks.locked(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def path(tmp_path):
    return tmp_path / "new folder" / "press"


def test_one_process_at_a_time(path):
    child = subprocess.Popen(
        [sys.executable, "-c", HOLD, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    with child:
        assert child.stdout
        assert child.stdout.readline() == b"held\n"
        with (
            pytest.raises(ValueError, match="press"),
            locks.locked(path),
        ):
            pass
        kill = threading.Thread(target=child.send_signal, args=(signal.SIGKILL,))
        with locks.locked(path, kill.start):  # waits for the lock
            assert kill.ident
            assert child.wait(60) == -signal.SIGKILL
    with locks.locked(path):  # the lock file of a killed process does not block
        assert path.parent.exists()
    assert not list(path.parent.iterdir())


def test_never_two_at_a_time(path):
    """Some wait for a lock file that is deleted meanwhile, others create a new one."""
    inside, turns, calls, waited = [], [], [], threading.Event()

    def wait(number, turn):
        calls.append((number, turn))
        waited.set()

    def work(number):
        for turn in range(20):
            with locks.locked(path, lambda: wait(number, turn)):  # noqa: B023
                inside.append(number)
                assert waited.wait(60)  # the first holder keeps the lock until another waits
                time.sleep(0.0005)
                assert inside == [number]
                turns.append((number, turn))
                inside.remove(number)

    with ThreadPoolExecutor(8) as pool:
        for one in [pool.submit(work, number) for number in range(8)]:
            one.result()
    assert len(turns) == 8 * 20
    assert len(calls) == len(set(calls))  # called once each, however often it must wait
    assert not os.listdir(path.parent)


@pytest.mark.parametrize("anew", [False, True])
def test_a_lock_on_a_deleted_file_does_not_count(path, monkeypatch, anew):
    lock, flock, calls = path.with_name(".press.lock"), fcntl.flock, []

    def late(file, how):
        if not calls:
            lock.unlink()
            if anew:
                lock.touch()
        calls.append(how)
        flock(file, how)

    monkeypatch.setattr(fcntl, "flock", late)
    with locks.locked(path):
        assert len(calls) == 2
        with (
            pytest.raises(ValueError, match=f"press is in use by process {os.getpid()} on"),
            locks.locked(path),
        ):
            pass


@pytest.mark.parametrize("kind", ["link", "folder"])
def test_a_lock_file_must_be_regular(path, kind):
    """Following a link would create or write its target."""
    path.parent.mkdir()
    lock = path.with_name(".press.lock")
    lock.mkdir() if kind == "folder" else lock.symlink_to("precious")
    with pytest.raises(ValueError, match=r"press\.lock"), locks.locked(path):
        pass
    assert [file.name for file in path.parent.iterdir()] == [lock.name]
