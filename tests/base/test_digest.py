"""Array digests do not depend on where arrays are, and detect flipped bits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.base import digest

VALUES = np.random.default_rng(0).normal(size=(8, 5, 7)) * 100


@pytest.mark.parametrize("dtype", ["float32", "bfloat16", "float8_e4m3fn", "uint8", "bool"])
def test_host_device_and_shards_have_the_same_digest(dtype):
    array = jnp.asarray(VALUES).astype(dtype)
    mesh = jax.make_mesh((8,), ("data",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("data"))
    found = [{"x": a, "e": a[:, :0]} for a in (array, np.asarray(array))]
    found.append(found[0] | {"x": jax.device_put(array, sharding)})
    assert len({digest.digest(arrays, "more") for arrays in found}) == 1
    assert digest.digest(found[0]) != digest.digest(found[0], "more")
    half = {"x": array.astype(jnp.bfloat16)}
    same = digest.fingerprints(half) == digest.fingerprints({"x": array})
    assert same == jnp.issubdtype(dtype, jnp.floating)


@pytest.mark.parametrize("index", [0, 41, 279])
@pytest.mark.parametrize("bit", [0, 31])
def test_a_flipped_bit_changes_the_digest(index, bit):
    words = VALUES.astype(np.float32).view(np.uint32).copy()
    before = digest.digest({"x": jax.device_put(words)})
    words.flat[index] ^= np.uint32(1 << bit)
    assert digest.digest({"x": jax.device_put(words)}) != before
