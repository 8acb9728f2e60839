"""Digests that detect corrupted data.

Array digests do not depend on the sharding. Orbax misses some corruption: it stores incompressible
data raw, where a flipped bit silently restores a different value. JSON digests are stored with the
values, under "digest".
"""

import hashlib
import json
import zlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

DIGEST = "digest"
"""Key of a JSON object's digest."""


def digest(arrays: Mapping[str, jax.Array], *extra: str) -> str:
    """Return the SHA-256 (hex) of `extra` and each array's name, dtype, shape and checksum."""
    entries = [
        [name, str(array.dtype), list(array.shape), _checksum(array)]
        for name, array in sorted(arrays.items())
    ]
    return hashlib.sha256(json.dumps([entries, extra]).encode()).hexdigest()


def fingerprints(weights: Mapping[str, Any]) -> dict[str, str]:
    """Hash each array to eight hex digits, in bf16 so that fp32 and bf16 copies match."""
    return {name: f"{_checksum(array, rounded=True):08x}" for name, array in weights.items()}


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


def _checksum(array: Any, *, rounded: bool = False) -> int:
    """Compute the CRC-32 of an array's bytes, optionally of floats rounded to bf16.

    It detects every flipped bit, and misses any other change with probability 2^-32.
    """
    if isinstance(array, jax.Array) and not array.is_fully_addressable:
        array = multihost_utils.process_allgather(array, tiled=True)
    array = np.asarray(array)
    if rounded and jnp.issubdtype(array.dtype, jnp.floating):
        array = array.astype(jnp.bfloat16)
    return zlib.crc32(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
