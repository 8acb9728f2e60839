"""Gathered decoding against the dense path."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.peft import LoRASP
from lorasp_jax.peft.lora_sp import decoding
from tests.cases import mostly_slow

pytestmark = pytest.mark.slow

D_IN, D_OUT = 24, 40
METHOD = LoRASP(rank=16, hidden_width=4, energy_target=0.7)
VARIANTS = [
    METHOD,
    dataclasses.replace(METHOD, router="gelu_relu"),
    dataclasses.replace(METHOD, normalized_bank=True),
    dataclasses.replace(METHOD, rank=12, alpha=24.0),
    LoRASP.paper(rank=16, energy_target=0.7),
]
IDS = ["default", "relu", "normalized", "pruned", "paper"]


def arrays(method, dtype):
    params, _ = method.init(jax.random.key(1), jax.ShapeDtypeStruct((D_IN, D_OUT), jnp.float32))
    leaves, structure = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(2), len(leaves))
    moved = [p + jax.random.normal(k, p.shape) for k, p in zip(keys, leaves, strict=True)]
    params = jax.tree.unflatten(structure, moved)
    if method.rank == 12:  # of 16 that the router scores
        whole, _ = arrays(METHOD, dtype)
        params |= {"router": whole["router"]}
    return params, decoding.prepare(method, params, dtype)


@pytest.mark.parametrize("method", mostly_slow(VARIANTS, VARIANTS[:1]), ids=IDS)
def test_equals_the_dense_path(method):
    params, prepared = arrays(method, jnp.float32)
    tokens = jax.random.normal(jax.random.key(3), (20, D_IN))
    expected, aux = jax.jit(method.delta)(params, tokens)
    run = jax.jit(
        jax.vmap(lambda x: decoding.decode(method, prepared, x, capacity=method.rank - 1))
    )
    found, missed = run(tokens)
    room = aux.active_rank < method.rank
    assert room.sum() > 10
    np.testing.assert_array_equal(missed[room], 0)
    np.testing.assert_allclose(found[room], expected[room], rtol=1e-4, atol=1e-4)


def test_says_what_found_no_room():
    """Left out are the lowest scores: a target that keeps only the others gives the same."""
    params, prepared = arrays(METHOD, jnp.float32)
    x = jax.random.normal(jax.random.key(4), (D_IN,))
    _, aux = METHOD.delta(params, x)
    active = int(aux.active_rank)
    assert active > 3
    found, missed = decoding.decode(METHOD, prepared, x, capacity=2)
    assert missed == active - 2
    for target in np.linspace(0.01, 0.7, 100):
        fewer = dataclasses.replace(METHOD, energy_target=round(float(target), 3))
        expected, aux = fewer.delta(params, x)
        if aux.active_rank == 2:
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
            return
    pytest.fail("no target keeps two directions")


def test_low_precision():
    _, prepared = arrays(METHOD, jnp.bfloat16)
    found, _ = decoding.decode(METHOD, prepared, jnp.ones(D_IN, jnp.bfloat16), capacity=4)
    assert found.dtype == jnp.bfloat16


@pytest.mark.parametrize("capacity", [0, 17])
def test_bad_capacity(capacity):
    _, prepared = arrays(METHOD, jnp.float32)
    with pytest.raises(ValueError, match=f"a capacity of 1 to 16, got .*24.* and {capacity}"):
        decoding.decode(METHOD, prepared, jnp.ones(D_IN), capacity=capacity)


def test_needs_masks_by_token():
    method = dataclasses.replace(METHOD, granularity="sample")
    params, _ = method.init(jax.random.key(1), jnp.zeros((D_IN, D_OUT)))
    with pytest.raises(ValueError, match="needs granularity 'token' and no schedule"):
        decoding.prepare(method, params, jnp.float32)
