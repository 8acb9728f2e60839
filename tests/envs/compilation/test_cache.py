"""Processes that share a compilation cache read only complete programs."""

import threading

import pytest
from jax._src import compilation_cache

from envs.compilation.cache import WholeFiles


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
