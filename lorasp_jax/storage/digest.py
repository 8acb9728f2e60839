"""Digests: by them what was read is known to be what was written.

Of arrays they are computed where these lie, the same on any number of devices. Orbax's files notice
much damage, not all of it: numbers that do not compress are stored as they are, and a flipped bit
among them is restored as another number. Of JSON they stand beside the values, under "digest".
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


def digest(arrays: Mapping[str, jax.Array], *notes: str) -> str:
    """SHA-256, in hexadecimal, of names, types, shapes and sums of the arrays, and of the notes."""
    sums = jax.device_get({name: _sum(array) for name, array in arrays.items()})
    facts = [
        [name, str(array.dtype), list(array.shape), int(sums[name])]
        for name, array in sorted(arrays.items())
    ]
    return hashlib.sha256(json.dumps([facts, notes]).encode()).hexdigest()


def fingerprints(weights: Mapping[str, Any]) -> dict[str, str]:
    """Eight hexadecimal digits of each array's values, rounded to bf16: the types that weights are
    kept in agree.
    """
    sums = jax.device_get({name: _sum(array, rounded=True) for name, array in weights.items()})
    return {name: f"{int(found):08x}" for name, found in sums.items()}


def sealed(facts: Mapping[str, Any]) -> dict[str, Any]:
    """JSON values with their digest.

    Raises:
        TypeError: something that JSON cannot hold.
    """
    return {**facts, DIGEST: _json_digest(facts)}


def unsealed(found: Any) -> dict[str, Any]:
    """What was sealed.

    Raises:
        ValueError: it is no such object, or not as it was.
    """
    if not isinstance(found, dict) or DIGEST not in found:
        raise ValueError("it has no digest")
    facts = {name: value for name, value in found.items() if name != DIGEST}
    if found[DIGEST] != _json_digest(facts):
        raise ValueError("its digest is another one")
    return facts


def _json_digest(facts: Mapping[str, Any]) -> str:
    """The first 16 digits of SHA-256 of the values, however they are laid out in a file."""
    plain = json.loads(json.dumps(facts))  # keys are texts there
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def _sum(array: Any, *, rounded: bool = False) -> Any:
    """`mixed_sum`, where asked for of floating-point numbers in bf16; by NumPy where that can read
    the array, since then nothing need be compiled for its shape."""
    rounded = rounded and jnp.issubdtype(array.dtype, jnp.floating)
    at_hand = isinstance(array, np.ndarray) or (
        array.is_fully_addressable and all(d.platform == "cpu" for d in array.devices())
    )
    if not at_hand:
        return mixed_sum(array, rounded=rounded)
    array = np.asarray(array)
    return host_sum(array.astype(jnp.bfloat16) if rounded else array)


def host_sum(array: np.ndarray, part: int = 2**18) -> int:
    """`mixed_sum` by NumPy, so many words at a time: a cache holds them."""
    words = np.ascontiguousarray(array).reshape(-1).view(f"uint{min(8 * array.itemsize, 32)}")
    total = 0
    for start in range(0, len(words), part):
        mixed = words[start : start + part].astype(np.uint32)
        mixed ^= np.arange(start, start + len(mixed)).astype(np.uint32) * np.uint32(0x9E3779B9)
        mixed = (mixed ^ (mixed >> 16)) * np.uint32(0x85EBCA6B)
        mixed = (mixed ^ (mixed >> 13)) * np.uint32(0xC2B2AE35)
        total += int(np.sum(mixed ^ (mixed >> 16), dtype=np.uint64))
    return total % 2**32


@functools.partial(jax.jit, static_argnames="rounded")
def mixed_sum(array: jax.Array, *, rounded: bool = False) -> jax.Array:
    """`[]` uint32, the sum of all elements' bits, in bf16 if rounded, each mixed with its position.

    Mixing is the finalizer of MurmurHash3 (github.com/aappleby/smhasher, MurmurHash3.cpp:68), a
    permutation of the 32-bit words: no change of a single word stays unseen, another one with a
    probability of 2^-32. Sums of integers do not depend on their order.
    """
    if rounded or array.dtype == bool:
        array = array.astype(jnp.bfloat16 if rounded else jnp.uint8)
    kind = jnp.dtype(f"uint{min(8 * array.dtype.itemsize, 32)}")
    words = jax.lax.bitcast_convert_type(array, kind).astype(jnp.uint32)
    position = jnp.zeros(words.shape, jnp.uint32)
    for axis in range(words.ndim):
        stride = jnp.uint32(math.prod(words.shape[axis + 1 :]) % 2**32)
        position += stride * jax.lax.broadcasted_iota(jnp.uint32, words.shape, axis)
    words ^= position * jnp.uint32(0x9E3779B9)
    words = (words ^ (words >> 16)) * jnp.uint32(0x85EBCA6B)
    words = (words ^ (words >> 13)) * jnp.uint32(0xC2B2AE35)
    return jnp.sum(words ^ (words >> 16), dtype=jnp.uint32)
