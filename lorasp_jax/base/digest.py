"""Digests that detect corrupted data.

Array digests are computed on the arrays' devices and do not depend on the sharding. Orbax misses
some corruption: it stores incompressible data raw, where a flipped bit silently restores a
different value. JSON digests are stored with the values, under "digest".
"""

import functools
import hashlib
import json
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

DIGEST = "digest"
"""Key of a JSON object's digest."""
_SMALL = 2**28
"""Arrays of so many bytes in all take NumPy less time than compiling for their shapes."""


def digest(arrays: Mapping[str, jax.Array], *extra: str) -> str:
    """Return the SHA-256 (hex) of `extra` and each array's name, dtype, shape and `mixed_sum`."""
    sums = _sums(arrays)
    entries = [
        [name, str(array.dtype), list(array.shape), int(sums[name])]
        for name, array in sorted(arrays.items())
    ]
    return hashlib.sha256(json.dumps([entries, extra]).encode()).hexdigest()


def fingerprints(weights: Mapping[str, Any]) -> dict[str, str]:
    """Hash each array to eight hex digits, in bf16 so that fp32 and bf16 copies match."""
    sums = _sums(weights, rounded=True)
    return {name: f"{int(value):08x}" for name, value in sums.items()}


def with_digest(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return JSON values with their digest added.

    Raises:
        TypeError: a value is not JSON-serializable.
    """
    return {**values, DIGEST: _json_digest(values)}


def verify_digest(content: Any) -> dict[str, Any]:
    """Verify the digest of `with_digest` and return the values without it.

    Raises:
        ValueError: the digest is missing or does not match.
    """
    if not isinstance(content, dict) or DIGEST not in content:
        raise ValueError("the digest is missing")
    values = {name: value for name, value in content.items() if name != DIGEST}
    if content[DIGEST] != _json_digest(values):
        raise ValueError("the digest does not match")
    return values


def _json_digest(values: Mapping[str, Any]) -> str:
    """Return the first 16 hex digits of the SHA-256 of JSON values, independent of formatting."""
    normalized = json.loads(json.dumps(values))  # turns all keys into strings
    return hashlib.sha256(json.dumps(normalized, sort_keys=True).encode()).hexdigest()[:16]


def _sums(arrays: Mapping[str, Any], *, rounded: bool = False) -> dict[str, Any]:
    """Compute `mixed_sum` of each array, optionally of floats rounded to bf16.

    What is in host memory or small uses NumPy, which compiles nothing for each shape.
    """
    small = sum(array.nbytes for array in arrays.values()) <= _SMALL

    def compute(array: Any) -> Any:
        rounds = rounded and jnp.issubdtype(array.dtype, jnp.floating)
        on_host = isinstance(array, np.ndarray) or (
            array.is_fully_addressable
            and (small or all(d.platform == "cpu" for d in array.devices()))
        )
        if not on_host:
            return mixed_sum(array, rounded=rounds)
        array = np.asarray(array)
        return host_sum(array.astype(jnp.bfloat16) if rounds else array)

    return jax.device_get({name: compute(array) for name, array in arrays.items()})


def host_sum(array: np.ndarray, block: int = 2**18) -> int:
    """Compute `mixed_sum` in NumPy, `block` words at a time so that they fit in the CPU cache."""
    words = np.ascontiguousarray(array).reshape(-1).view(f"uint{min(8 * array.itemsize, 32)}")
    total = 0
    for start in range(0, len(words), block):
        mixed = words[start : start + block].astype(np.uint32)
        mixed ^= np.arange(start, start + len(mixed)).astype(np.uint32) * np.uint32(0x9E3779B9)
        mixed = (mixed ^ (mixed >> 16)) * np.uint32(0x85EBCA6B)
        mixed = (mixed ^ (mixed >> 13)) * np.uint32(0xC2B2AE35)
        total += int(np.sum(mixed ^ (mixed >> 16), dtype=np.uint64))
    return total % 2**32


@functools.partial(jax.jit, static_argnames="rounded")
def mixed_sum(array: jax.Array, *, rounded: bool = False) -> jax.Array:
    """Sum the 32-bit words of all elements, each mixed with its position: `[]` uint32.

    Elements are read bitwise as integers, 64-bit ones as two words. `rounded` first casts them to
    bf16. Words are mixed by the finalizer of MurmurHash3 (github.com/aappleby/smhasher,
    MurmurHash3.cpp:68), a permutation of 32-bit words. A change of a single word is therefore
    always detected, and any other is missed with probability 2^-32. Integer addition is exact, so
    the order of summation does not matter.
    """
    if rounded or array.dtype == bool:
        array = array.astype(jnp.bfloat16 if rounded else jnp.uint8)
    word = jnp.dtype(f"uint{min(8 * array.dtype.itemsize, 32)}")
    words = jax.lax.bitcast_convert_type(array, word).astype(jnp.uint32)
    position = jnp.zeros(words.shape, jnp.uint32)
    for axis in range(words.ndim):
        stride = jnp.uint32(math.prod(words.shape[axis + 1 :]) % 2**32)
        position += stride * jax.lax.broadcasted_iota(jnp.uint32, words.shape, axis)
    words ^= position * jnp.uint32(0x9E3779B9)
    words = (words ^ (words >> 16)) * jnp.uint32(0x85EBCA6B)
    words = (words ^ (words >> 13)) * jnp.uint32(0xC2B2AE35)
    return jnp.sum(words ^ (words >> 16), dtype=jnp.uint32)
