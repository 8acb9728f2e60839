"""Array digests are the same on host and device, and detect flipped bits."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import monitoring

from lorasp_jax.base import digest

VALUES = np.random.default_rng(0).normal(size=(3, 5, 7)) * 100


@pytest.fixture
def compiled():
    """Events of JAX compiling a program or loading it from its cache."""
    events = []

    def listen(event, *_, **__):
        if event == "/jax/core/compile/backend_compile_duration":
            events.append(event)

    monitoring.register_event_duration_secs_listener(listen)
    yield events
    monitoring.unregister_event_duration_listener(listen)


@pytest.mark.parametrize(
    "dtype", ["float32", "bfloat16", "float8_e4m3fn", "int32", "uint8", "bool", "float16"]
)
@pytest.mark.parametrize("rounded", [False, True])
def test_host_equals_device(dtype, rounded):
    array = jnp.asarray(VALUES).astype(dtype)
    rounded = rounded and jnp.issubdtype(dtype, jnp.floating)
    on_host = np.asarray(array.astype(jnp.bfloat16) if rounded else array)
    blocked = digest.host_sum(on_host, block=16)  # several blocks, the last one shorter
    assert blocked == digest.host_sum(on_host) == int(digest.mixed_sum(array, rounded=rounded))


def test_nothing_is_compiled_on_cpu(compiled):
    arrays = {"a": jnp.ones((2, 37)), "b": np.ones(2), "c": jnp.zeros(()), "d": jnp.ones((0, 4))}
    other = arrays | {"c": jnp.ones(())}
    compiled.clear()
    assert digest.digest(arrays) != digest.digest(other)
    assert compiled == []
    digest.mixed_sum(arrays["a"])
    assert compiled


@dataclasses.dataclass
class OnGpu:
    """An array that a GPU holds, if it tells the truth."""

    array: np.ndarray
    is_fully_addressable = True

    def __getattr__(self, name):
        return getattr(self.array, name)

    def devices(self):
        return [SimpleNamespace(platform="gpu")]

    def __array__(self, dtype=None, copy=None):
        return self.array


def test_few_bytes_leave_the_gpu(monkeypatch):
    sums, held = [], {"a": OnGpu(np.ones(37, np.float32)), "b": OnGpu(np.ones(3, np.int32))}
    monkeypatch.setattr(digest, "mixed_sum", lambda array, rounded: sums.append(array) or 0)
    few = digest.digest(held)
    assert few == digest.digest({name: each.array for name, each in held.items()})
    assert not sums
    monkeypatch.setattr(digest, "_SMALL", 4 * 40 - 1)
    assert digest.digest(held) != few
    assert len(sums) == 2


@pytest.mark.parametrize("index", [0, 41, 104])
@pytest.mark.parametrize("bit", [0, 31])
def test_a_flipped_bit_changes_the_digest(index, bit):
    words = VALUES.astype(np.float32).view(np.uint32).copy()
    before = digest.digest({"x": jax.device_put(words)})
    words.flat[index] ^= np.uint32(1 << bit)
    assert digest.digest({"x": jax.device_put(words)}) != before
