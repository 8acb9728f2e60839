"""One thread or process compiles a program, while the others wait."""

import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import filelock
import pytest

from lorasp_jax.base import turns

CLAIM = """
import pathlib, sys
from lorasp_jax.base import turns

turns.take(pathlib.Path(sys.argv[1]))
print("claimed", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def file(tmp_path):
    return tmp_path / "program-lock"


@pytest.fixture
def another():
    """A thread that waits in the background."""
    with ThreadPoolExecutor(1) as executor:
        yield executor
        executor.submit(turns.end)


@pytest.fixture
def found_claimed(monkeypatch):
    """An event: a thread has found a program claimed, and waits."""
    event, acquire = threading.Event(), turns.acquire

    def noticed(file):
        try:
            return acquire(file)
        except filelock.Timeout:
            event.set()
            raise

    monkeypatch.setattr(turns, "acquire", noticed)
    return event


def test_others_wait_for_the_end_of_a_claim(file, another, found_claimed):
    turns.take(file)
    waiting = another.submit(turns.take, file)
    assert found_claimed.wait(60)
    assert not waiting.done()
    turns.end()
    waiting.result(60)
    assert not file.exists()


def test_whoever_has_waited_keeps_nobody_waiting(file, another, found_claimed):
    turns.take(file)
    waiting = another.submit(turns.take, file)
    assert found_claimed.wait(60)
    turns.end()
    waiting.result(60)
    with filelock.FileLock(file, timeout=0):
        pass


def test_a_thread_has_one_claim(file, another):
    turns.take(file)
    turns.take(file.with_name("next-lock"))
    another.submit(turns.take, file).result(60)
    assert file.exists()
    turns.end()
    assert not file.with_name("next-lock").exists()
    turns.end()


def test_opposite_orders_do_not_block(tmp_path):
    files = [tmp_path / name for name in "abcdef"]
    start = threading.Barrier(2)

    def compile_all(order):
        start.wait()
        for file in order:
            turns.take(file)
        turns.end()

    with ThreadPoolExecutor(2) as pool:
        for future in [pool.submit(compile_all, order) for order in (files, files[::-1])]:
            future.result(60)


def test_a_killed_process_keeps_nobody_waiting(file, another, found_claimed):
    arguments = [sys.executable, "-c", CLAIM, file]
    child = subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    with child:
        assert child.stdout
        assert child.stdout.readline() == b"claimed\n"
        waiting = another.submit(turns.take, file)
        assert found_claimed.wait(60)
        assert not waiting.done()
        child.kill()
        waiting.result(60)


def test_patience_has_an_end(file, another, monkeypatch):
    monkeypatch.setattr(turns, "PATIENCE", 0.1)
    turns.take(file)
    another.submit(turns.take, file).result(60)
    assert file.exists()  # still claimed
    turns.end()


def test_nobody_waits_without_a_lock(tmp_path):
    turns.take(tmp_path / ("x" * 300))
    turns.take(tmp_path / "missing/folder/lock")
    turns.end()
