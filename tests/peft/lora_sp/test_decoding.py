"""Test single-token decoding with gathered directions against the dense path."""

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
    if method.rank == 12:  # pruned: the router still scores 16 directions
        unpruned, _ = arrays(METHOD, dtype)
        params |= {"router": unpruned["router"]}
    return params, decoding.prepare(method, params, dtype)


@pytest.mark.parametrize("method", mostly_slow(VARIANTS, VARIANTS[:1]), ids=IDS)
def test_equals_the_dense_path(method):
    params, prepared = arrays(method, jnp.float32)
    tokens = jax.random.normal(jax.random.key(3), (20, D_IN))
    expected, aux = jax.jit(method.delta)(params, tokens)
    run = jax.jit(
        jax.vmap(lambda x: decoding.decode(method, prepared, x, capacity=method.rank - 1))
    )
    actual, dropped = run(tokens)
    fits = aux.active_rank < method.rank
    assert fits.sum() > 10
    np.testing.assert_array_equal(dropped[fits], 0)
    np.testing.assert_allclose(actual[fits], expected[fits], rtol=1e-4, atol=1e-4)


def test_directions_beyond_the_capacity():
    """The lowest scores are left out: a lower target that keeps only the others agrees."""
    params, prepared = arrays(METHOD, jnp.float32)
    x = jax.random.normal(jax.random.key(4), (D_IN,))
    _, aux = METHOD.delta(params, x)
    active = int(aux.active_rank)
    assert active > 3
    actual, dropped = decoding.decode(METHOD, prepared, x, capacity=2)
    assert dropped == active - 2
    for target in np.linspace(0.01, 0.7, 100):
        lower = dataclasses.replace(METHOD, energy_target=round(float(target), 3))
        expected, aux = lower.delta(params, x)
        if aux.active_rank == 2:
            np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-4)
            return
    pytest.fail("no target keeps two directions")


def test_bfloat16():
    _, prepared = arrays(METHOD, jnp.bfloat16)
    delta, _ = decoding.decode(METHOD, prepared, jnp.ones(D_IN, jnp.bfloat16), capacity=4)
    assert delta.dtype == jnp.bfloat16


@pytest.mark.parametrize("capacity", [0, 17])
def test_invalid_capacity(capacity):
    _, prepared = arrays(METHOD, jnp.float32)
    with pytest.raises(ValueError, match=f"a capacity of 1 to 16, got .*24.* and {capacity}"):
        decoding.decode(METHOD, prepared, jnp.ones(D_IN), capacity=capacity)


def test_requires_one_mask_per_token():
    method = dataclasses.replace(METHOD, granularity="sample")
    params, _ = method.init(jax.random.key(1), jnp.zeros((D_IN, D_OUT)))
    with pytest.raises(ValueError, match="needs granularity 'token' and no schedule"):
        decoding.prepare(method, params, jnp.float32)
