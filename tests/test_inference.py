"""Prepared adapters compute the same, from matrices that were joined and converted before."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from lorasp_jax import inference
from lorasp_jax.dense import Dense
from lorasp_jax.kernels.low_rank_matmul import Prepared
from lorasp_jax.models import pi0, smolvla
from lorasp_jax.models.layers import scan_depth, stack, unstacked
from tests import quick
from tests.cases import mostly_slow
from tests.models.drawn import drawn, observation
from tests.nets import METHODS, trained

ADDITIVE = [name for name in METHODS if name not in ("full", "dora")]


def stacked(method, dtype="bfloat16"):
    """Three layers [3, 8, 8], adapted."""
    layers = stack(lambda rngs: Dense(8, 8, dtype=dtype, rngs=rngs), 3, nnx.Rngs(0))
    return trained((".*", method), seed=1, net=layers)


def through(layers, x):
    def call(layer, x, _):
        return layer(x, return_aux=True)

    return scan_depth(layers, call, x)


@pytest.mark.parametrize("name", mostly_slow(ADDITIVE, ["lora_sp"]))
def test_computes_the_same(name):
    model, x = stacked(METHODS[name]), jnp.sin(jnp.arange(48.0)).reshape(6, 8).astype("bfloat16")
    ready = inference.prepared(model)
    params = ready.adapter.get_value()
    assert isinstance(params, Prepared)
    assert params.down.dtype == params.up.dtype == jnp.bfloat16
    assert not isinstance(model.adapter.get_value(), Prepared)
    expected, aux = through(model, x)
    for layers in (ready, unstacked(ready)):
        found, other = through(layers, x)
        np.testing.assert_allclose(
            *(np.float32(a) for a in (found, expected)), rtol=0.02, atol=0.02
        )
        assert jax.tree.structure(other) == jax.tree.structure(aux)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=0.02, atol=1e-3), other, aux
        )
    np.testing.assert_array_equal(params.up[1], METHODS[name].up(one(model, 1)).astype("bfloat16"))


def one(model, i):
    """Parameters of layer i."""
    return jax.tree.map(lambda a: a[i], model.adapter.get_value())


def test_what_cannot_be_prepared_stays():
    for model in (stacked(METHODS["dora"]), stacked(METHODS["lora"], dtype=None)):
        ready = inference.prepared(model)
        assert not isinstance(ready.adapter.get_value(), Prepared)
    twice = inference.prepared(inference.prepared(stacked(METHODS["lora"])))
    assert not isinstance(twice.adapter.get_value().params, Prepared)


@pytest.mark.parametrize(
    "backbone", [pi0, pytest.param(smolvla, marks=pytest.mark.slow)], ids=["pi0", "smolvla"]
)
def test_sampling_follows_the_velocity(backbone):
    config = backbone.Config.dummy()
    model = trained(("q_proj", METHODS["lora"]), seed=1, net=drawn(config))
    obs = observation(config, 2)
    noise = jax.random.normal(jax.random.key(0), (2, config.chunk, config.action_dim))
    velocity = quick.jit(lambda model, x, t: model.velocity(obs, x, jnp.full(2, t)))
    expected = noise - velocity(model, noise, 1.0) / 2
    expected -= velocity(model, expected, 0.5) / 2
    sample = quick.jit(
        lambda model: model.sample_actions(jax.random.key(0), obs, num_steps=2, noise=noise)
    )
    np.testing.assert_allclose(sample(model), expected, rtol=1e-4, atol=1e-5)
