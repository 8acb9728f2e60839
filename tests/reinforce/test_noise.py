"""The exploring policy: its probabilities, and its mean, which is the deterministic sampler."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from jax.scipy.stats import norm

from lorasp_jax.adapters import adaptation
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import LoRASP
from lorasp_jax.reinforce import noise
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, make_run

SLOTS = np.array([True, True, False, True])


def draw(seed, *shape):
    return jax.random.normal(jax.random.key(seed), shape)


def test_log_probabilities_are_those_of_a_normal_distribution():
    mean, actions = draw(0, 5, 3, 4), draw(1, 5, 3, 4)
    expected = norm.logpdf(actions, mean, 0.3)[..., SLOTS].sum(-1)
    np.testing.assert_allclose(noise.log_prob(mean, actions, 0.3, SLOTS), expected, rtol=1e-5)


def test_probabilities_of_two_actions_integrate_to_one():
    grid = jnp.linspace(-1, 2, 301)
    actions = jnp.stack(jnp.meshgrid(grid, grid), axis=-1)
    density = jnp.exp(noise.log_prob(jnp.array([0.4, 0.6]), actions, 0.1, np.ones(2, bool)))
    assert float(density.sum() * 0.01**2) == pytest.approx(1, abs=1e-4)


def test_divergence_is_the_mean_difference_of_log_probabilities():
    mean, other = draw(0, 4) * 0.1, draw(1, 4) * 0.1
    actions = noise.explore(jax.random.key(2), jnp.broadcast_to(mean, (100_000, 4)), 0.2, SLOTS)
    difference = [noise.log_prob(x, actions, 0.2, SLOTS) for x in (mean, other)]
    sampled = float(jnp.mean(difference[0] - difference[1]))
    assert sampled == pytest.approx(float(noise.divergence(mean, other, 0.2, SLOTS)), rel=0.03)


def test_exploration_leaves_other_slots_alone():
    mean = draw(0, 1000, 4)
    change = noise.explore(jax.random.key(1), mean, 0.1, SLOTS) - mean
    assert not change[:, ~SLOTS].any()
    np.testing.assert_allclose(jnp.std(change[:, SLOTS], axis=0), 0.1, rtol=0.1)


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
    found, _ = noise.means(policy.model, processor, raw, prompts, flow, steps)
    obs = processor.encode(raw, prompts)
    options = {"num_steps": steps, "noise": flow, "slots": processor.flow_slots}
    expected = policy.model.sample_actions(None, obs, **options)
    np.testing.assert_allclose(found, expected, atol=2e-5)
    np.testing.assert_allclose(
        found, policy.with_sampler().model.sample_actions(None, obs, **options), atol=2e-5
    )
