"""Training-time real-time chunking from end to end: policies learn to continue a prefix."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from lorasp_jax.models import flow_matching
from lorasp_jax.models.flow_matching import Times
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig
from tests.models.random_models import observation, random_backbone

CONFIGS = {
    "pi0": Pi0Config.dummy(),
    "pi05": dataclasses.replace(Pi0Config.dummy(), pi05=True),
    "smolvla": SmolVLAConfig.dummy(),
}
BATCH, STEPS, MAX_DELAY, LEARNING_RATE = 16, 400, 2, 3e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", CONFIGS)
def test_policies_learn_to_continue_a_prefix(name):
    """Half of the chunks are the negative of the others, and only given actions tell which.

    Pure noise does not tell either, so that the error of the velocity is at least the variance of
    the actions, 1.28 for those after the prefix. Given actions remove it, and decide the sample.
    """
    model = random_backbone(CONFIGS[name])
    obs = jax.tree.map(lambda x: jnp.repeat(x[:1], BATCH, axis=0), observation(model.config, 2))
    chunk, dim = model.config.chunk, model.config.action_dim
    sign = np.where(np.arange(BATCH) % 2, 1.0, -1.0)[:, None, None]
    actions = jnp.asarray(sign * (0.5 + 0.25 * np.arange(chunk)[:, None]) * np.ones(dim))
    model = _trained(model, obs, actions)
    noise = jax.random.normal(jax.random.key(1), actions.shape)

    @jax.jit
    def error(model: Any, length: jax.Array) -> jax.Array:
        time = jnp.where(flow_matching.first(length, chunk), 0.0, jnp.ones((BATCH, 1)))
        return model.loss(None, obs, actions, noise=noise, flow_time=time)[0][:, MAX_DELAY:].mean()

    free, *given = (error(model, d) for d in range(MAX_DELAY + 1))
    assert free > 1.2
    assert max(given) < 0.25 * free
    sample = jax.jit(
        lambda model, d: model.sample_actions(
            None, obs, noise=noise, prefix=actions, prefix_length=d
        )
    )
    agrees = lambda d: np.mean(sign * sample(model, d)[:, MAX_DELAY:] > 0)  # noqa: E731
    assert agrees(0) < 0.8
    assert [agrees(d) for d in range(1, MAX_DELAY + 1)] == [1, 1]


def _trained(model: Any, obs: Any, actions: jax.Array) -> Any:
    """Return the model after training all of its parameters."""
    graphdef, params = nnx.split(model)
    optimizer = optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, STEPS))

    def loss(params: Any, key: jax.Array) -> jax.Array:
        noise, time = flow_matching.draw(key, actions, Times(max_delay=MAX_DELAY))
        model = nnx.merge(graphdef, params)
        error, _ = model.loss(key, obs, actions, noise=noise, flow_time=time)
        return jnp.mean(error, where=(time > 0)[..., None])

    def step(carry: Any, key: jax.Array) -> Any:
        params, opt_state = carry
        updates, opt_state = optimizer.update(jax.grad(loss)(params, key), opt_state)
        return (optax.apply_updates(params, updates), opt_state), None

    keys = jax.random.split(jax.random.key(0), STEPS)
    train = jax.jit(lambda carry, keys: jax.lax.scan(step, carry, keys)[0])
    params, _ = train((params, optimizer.init(params)), keys)
    return nnx.merge(graphdef, params)
