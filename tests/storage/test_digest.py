"""Digests of arrays are the same wherever they are computed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.storage import digest

VALUES = np.random.default_rng(0).normal(size=(3, 5, 7)) * 100


@pytest.mark.parametrize(
    "dtype", ["float32", "bfloat16", "float8_e4m3fn", "int32", "uint8", "bool", "float16"]
)
@pytest.mark.parametrize("rounded", [False, True])
def test_the_host_finds_what_a_device_finds(dtype, rounded, monkeypatch):
    monkeypatch.setattr(digest, "_PART", 16)  # several parts, the last one shorter
    array = jnp.asarray(VALUES).astype(dtype)
    found = digest._sum(array, rounded=rounded)
    assert isinstance(found, int)
    monkeypatch.setattr(digest, "_is_at_hand", lambda _: False)
    assert found == int(digest._sum(array, rounded=rounded))


def test_nothing_is_compiled_on_a_cpu(monkeypatch):
    monkeypatch.setattr(digest, "_mixed_sum", pytest.fail)
    arrays = {"a": jnp.ones((2, 3)), "b": np.ones(2), "c": jnp.zeros(()), "d": jnp.ones((0, 4))}
    assert digest.digest(arrays) != digest.digest(arrays | {"c": jnp.ones(())})


@pytest.mark.parametrize("index", [0, 41, 104])
@pytest.mark.parametrize("bit", [0, 31])
def test_one_bit_more_is_another_digest(index, bit):
    words = VALUES.astype(np.float32).view(np.uint32).copy()
    before = digest.digest({"x": jax.device_put(words)})
    words.flat[index] ^= np.uint32(1 << bit)
    assert digest.digest({"x": jax.device_put(words)}) != before
