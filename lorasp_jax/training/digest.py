"""A digest of arrays' values, computed where they lie, the same on any number of devices.

Orbax's files notice much damage, not all of it: numbers that do not compress are stored as they
are, and a flipped bit among them is restored as another number.
"""

import hashlib
import json
import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp


def digest(arrays: Mapping[str, jax.Array], *notes: str) -> str:
    """SHA-256, in hexadecimal, of names, types, shapes and sums of the arrays, and of the notes."""
    sums = jax.device_get({name: _mixed_sum(array) for name, array in arrays.items()})
    facts = [
        [name, str(array.dtype), list(array.shape), int(sums[name])]
        for name, array in sorted(arrays.items())
    ]
    return hashlib.sha256(json.dumps([facts, notes]).encode()).hexdigest()


@jax.jit
def _mixed_sum(array: jax.Array) -> jax.Array:
    """`[]` uint32, the sum of all elements' bits, each mixed with its position.

    Mixing is the finalizer of MurmurHash3 (github.com/aappleby/smhasher, MurmurHash3.cpp:68), a
    permutation of the 32-bit words: no change of a single word stays unseen, another one with a
    probability of 2^-32. Sums of integers do not depend on their order.
    """
    if array.dtype == bool:
        array = array.astype(jnp.uint8)
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
