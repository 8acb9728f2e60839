"""Processes that share a compilation cache read whole programs only."""

import os
import subprocess
import sys
import threading

import pytest

from envs.compilation_cache import WholeFiles


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


def test_an_entry_that_a_killed_process_left_is_written_again(cache, tmp_path):
    (tmp_path / "key-cache").write_bytes(b"hal")
    cache.put("key", b"whole")
    assert cache.get("key") == b"whole"


def test_a_write_that_fails_leaves_nothing(cache, tmp_path):
    with pytest.raises(TypeError):
        cache.put("key", "no bytes")  # pyright: ignore[reportArgumentType]
    assert not list(tmp_path.iterdir())


def test_programs_are_kept_and_read(tmp_path):
    code = (
        "import jax\n"
        "from envs import compilation_cache\n"
        "compilation_cache.enable()\n"
        "jax.config.update('jax_persistent_cache_min_compile_time_secs', 0.0)\n"
        "hits = []\n"
        "jax.monitoring.register_event_listener(lambda name, **_: hits.append(name))\n"
        "jax.jit(lambda x: x * 3 + 1)(2.0)\n"
        "from jax._src import compilation_cache as theirs\n"
        "assert type(theirs._cache) is compilation_cache.WholeFiles\n"
        "print('/jax/compilation_cache/cache_hits' in hits)"
    )
    env = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_PLATFORMS": "cpu"}
    said = [
        subprocess.run([sys.executable, "-c", code], env=env, check=True, capture_output=True)
        for _ in range(2)
    ]
    assert [run.stdout.decode().strip() for run in said] == ["False", "True"]
    assert not list(tmp_path.glob(".*"))
