"""The exploring policy: its probabilities, and its mean, which is the deterministic sampler."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from jax.scipy.stats import multivariate_normal

from lorasp_jax.adapters import adaptation
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import LoRASP
from lorasp_jax.reinforce import noise, rollout
from lorasp_jax.reinforce.noise import Spread
from lorasp_jax.reinforce.rollout import Chunks
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, make_run

SLOTS = np.array([True, True, False, True])


def draw(seed, *shape):
    return jax.random.normal(jax.random.key(seed), shape)


def covariance(spread, length):
    past = np.abs(np.subtract.outer(np.arange(length), np.arange(length)))
    return spread.std**2 * spread.correlation**past


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_log_probabilities_are_those_of_a_normal_distribution(correlation):
    mean, actions = draw(0, 5, 3, 4), draw(1, 5, 3, 4)
    spread = Spread(0.3, correlation)
    found = noise.log_prob(mean, actions, spread, SLOTS)
    assert found.shape == (5, 3)
    together = covariance(spread, 3)
    change = jnp.swapaxes(actions - mean, 1, 2)[:, SLOTS]
    for length in (1, 2, 3):  # each action given the earlier ones
        part = change[..., :length], np.zeros(length), together[:length, :length]
        expected = multivariate_normal.logpdf(*part).sum(-1)
        np.testing.assert_allclose(found[:, :length].sum(-1), expected, rtol=2e-4)


def test_probabilities_of_two_actions_integrate_to_one():
    grid = jnp.linspace(-1, 2, 301)
    actions = jnp.stack(jnp.meshgrid(grid, grid), axis=-1)
    actions = actions[..., None, :]
    spread, mean = Spread(0.1, 0.5), jnp.array([[0.4, 0.6]])
    density = jnp.exp(noise.log_prob(mean, actions, spread, np.ones(2, bool)))
    assert float(density.sum() * 0.01**2) == pytest.approx(1, abs=1e-4)


def test_divergence_is_the_mean_difference_of_log_probabilities():
    spread, mean, other = Spread(0.2, 0.7), draw(0, 3, 4) * 0.1, draw(1, 3, 4) * 0.1
    many = jnp.broadcast_to(mean, (100_000, 3, 4))
    actions = noise.explore(jax.random.key(2), many, spread, SLOTS)
    difference = [noise.log_prob(x, actions, spread, SLOTS) for x in (mean, other)]
    sampled = jnp.mean(difference[0] - difference[1], axis=0)
    np.testing.assert_allclose(sampled, noise.divergence(mean, other, spread, SLOTS), rtol=0.04)


def test_exploration_leaves_other_slots_alone():
    mean, spread = draw(0, 20_000, 3, 4), Spread(0.1, 0.8)
    change = noise.explore(jax.random.key(1), mean, spread, SLOTS) - mean
    assert not change[..., ~SLOTS].any()
    found = jnp.cov(change[..., 0].T)
    np.testing.assert_allclose(found, covariance(spread, 3), rtol=0.05)


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    config = dataclasses.replace(CONFIG, peft=LoRASP(rank=4, hidden_width=4))
    model = random_backbone(Pi0Config.dummy())
    policy = make_run(tmp_path_factory.mktemp("run"), config, model).policy
    graphdef, adapters, frozen = adaptation.split(policy.model)
    adapters = jax.tree.map(
        lambda x: x + 0.05 * jnp.cos(jnp.arange(x.size)).reshape(x.shape), adapters
    )
    return dataclasses.replace(policy, model=nnx.merge(graphdef, adapters, frozen))


def inputs(policy, count=3):
    rng = np.random.default_rng(0)
    image = {n: rng.integers(0, 255, (count, 32, 32, 3), np.uint8) for n in ("side", "wrist")}
    state = rng.normal(size=(count, 7)).astype(np.float32)
    config = policy.model.config
    flow = draw(5, count, config.chunk, config.action_dim)
    return {"image": image, "state": state}, jnp.array([0, 1, 0]), flow


@pytest.mark.parametrize("steps", [1, 3])
def test_the_mean_is_the_deterministic_sample(policy, steps):
    raw, prompts, flow = inputs(policy)
    processor = policy.processor
    chunks = Chunks(raw, prompts, flow, flow)
    means = jax.jit(lambda model: rollout.means(model, processor, chunks, steps, 0.0)[0])
    obs = processor.encode(raw, prompts)
    options = {"num_steps": steps, "noise": flow, "slots": processor.flow_slots}
    sample = jax.jit(lambda model: model.sample_actions(None, obs, **options))
    for model in (policy.model, policy.with_sampler().model):
        np.testing.assert_allclose(means(policy.model), sample(model), atol=2e-5)
