"""Processes that share a compilation cache read only complete programs."""

import json
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import pytest
from jax._src import compilation_cache

from lorasp_jax.base import turns
from lorasp_jax.base.compilation_cache import WholeFiles
from tests import ROOT


@pytest.fixture
def cache(tmp_path):
    return WholeFiles(str(tmp_path), max_size=-1)


def test_a_reader_never_sees_half_an_entry(cache):
    values = [bytes([i]) * 4_000_000 for i in range(8)]
    seen, done = set(), threading.Event()

    def read():
        while not done.is_set():
            found = cache.get("key")
            seen.add(None if found is None else (len(found), found[0], found[-1]))

    reader = threading.Thread(target=read)
    reader.start()
    for value in values:
        cache.put("key", value)
    done.set()
    reader.join()
    assert seen <= {None} | {(4_000_000, i, i) for i in range(8)}
    assert cache.get("key") == values[-1]


def test_a_half_written_entry_is_replaced(cache, tmp_path):
    (tmp_path / "key-cache").write_bytes(b"hal")
    cache.put("key", b"whole")
    assert cache.get("key") == b"whole"


def test_a_failed_write_leaves_nothing(cache, tmp_path):
    with pytest.raises(TypeError):
        cache.put("key", "no bytes")  # pyright: ignore[reportArgumentType]
    assert not list(tmp_path.iterdir())


def test_jax_uses_it(tmp_path):
    """`tests/conftest.py` enables it, as the commands do."""
    kept, folder = compilation_cache.get_file_cache(str(tmp_path))
    assert isinstance(kept, WholeFiles)
    assert folder == str(tmp_path)


def test_an_entry_is_waited_for(cache):
    assert cache.get("key") is None
    with ThreadPoolExecutor(1) as another:
        waiting = another.submit(cache.get, "key")
        cache.put("key", b"value")
        turns.end()
        assert waiting.result(60) == b"value"


def test_the_next_program_ends_the_wait_for_one_that_is_not_kept(cache):
    assert cache.get("key") is None
    with ThreadPoolExecutor(1) as another:
        waiting = another.submit(cache.get, "key")
        assert cache.get("next") is None
        assert waiting.result(60) is None
    turns.end()


def test_processes_of_a_distributed_run_do_not_wait(cache, tmp_path, monkeypatch):
    monkeypatch.setattr(jax.distributed, "is_initialized", lambda: True)
    assert cache.get("key") is None
    assert not list(tmp_path.iterdir())


def test_a_cache_of_limited_size_has_its_own_lock(tmp_path):
    assert WholeFiles(str(tmp_path), max_size=1000).get("key") is None
    assert not (tmp_path / "key-lock").exists()


def test_a_folder_without_locks_only_costs_time(cache, tmp_path):
    (tmp_path / "key-lock").mkdir()
    assert cache.get("key") is None
    cache.put("key", b"value")
    assert cache.get("key") == b"value"


def test_every_compilation_ends_its_claim(monkeypatch):
    ends = []
    monkeypatch.setattr(turns, "end", lambda: ends.append(1))
    jax.jit(lambda x: x + len(ends)).lower(1.0).compile()
    assert ends


COMPILE = """
import json

import jax

from lorasp_jax.base import cache

cache.enable()
events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event))

def slow(x):
    for i in range(300):
        x = jax.numpy.sin(x @ x) + i
    return x

x = jax.numpy.ones((8, 8))
print("compiling", flush=True)
jax.jit(slow).lower(x).compile()
print(json.dumps([event.rpartition("/")[2] for event in events]))
"""


def compile_at_once(folder, count, **options):
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(folder), "XLA_FLAGS": ""}
    options = {"cwd": ROOT, "env": environment, "text": True, "stdout": subprocess.PIPE, **options}
    arguments = [sys.executable, "-c", COMPILE]
    return [subprocess.Popen(arguments, **options) for _ in range(count)]


def compilations(children):
    """Return how many children compiled, and how many read, the program."""
    events = [event for c in children for event in json.loads(c.communicate()[0].split("\n")[1])]
    return events.count("cache_misses"), events.count("cache_hits")


@pytest.mark.slow
def test_processes_compile_a_program_once(tmp_path):
    assert compilations(compile_at_once(tmp_path, 3)) == (1, 2)
    assert [path.name.rpartition("-")[2] for path in tmp_path.iterdir()] == ["cache"]


@pytest.mark.slow
def test_a_process_killed_while_it_compiles_is_replaced(tmp_path):
    (first,) = compile_at_once(tmp_path, 1)
    with first:
        assert first.stdout
        assert first.stdout.readline() == "compiling\n"
        (other,) = compile_at_once(tmp_path, 1)
        while not list(tmp_path.glob("jit_slow*-lock")):
            assert first.poll() is None
        first.kill()
    assert compilations([other]) == (1, 0)
