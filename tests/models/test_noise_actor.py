"""A model with an actor samples from the noise that the actor chooses."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.models import pi0, smolvla
from lorasp_jax.models.noise_actor import NoiseActor, attach
from tests.models.random_models import observation, random_backbone, with_noise

STEPS, BATCH, STD = 2, 2, 0.6


@pytest.fixture(scope="module", params=[pi0, smolvla], ids=["pi0", "smolvla"])
def config(request):
    return request.param.Config.dummy()


@pytest.fixture(scope="module")
def model(config):
    return random_backbone(config)


@pytest.fixture(scope="module")
def actor(config):
    return with_noise(NoiseActor.init(jax.random.key(0), config, std=STD, widths=(16,)), 0.3)


def test_noise_is_the_shift_of_what_the_policy_sees(model, config, actor):
    obs, slots = observation(config, BATCH), np.arange(config.action_dim) < 5
    options = {"num_steps": STEPS, "slots": slots}
    noise = jax.random.normal(jax.random.key(1), (BATCH, config.chunk, config.action_dim))

    @jax.jit
    def expected():
        zeros = model.sample_actions(None, obs, noise=0 * noise, **options)
        seen = jnp.concatenate([obs.state, zeros.reshape(BATCH, -1)], axis=1)
        shift = actor.network(seen)[:, None]
        initial = shift + np.sqrt(1 - STD**2) * noise
        return shift, model.sample_actions(None, obs, noise=initial, **options)

    shift, chunk = expected()
    assert np.abs(shift[0] - shift[1]).max() > 0.1  # it depends on the observation
    steered = attach(model, actor)
    direct = jax.jit(lambda: steered.sample_actions(None, obs, noise=noise, **options))
    np.testing.assert_allclose(direct(), chunk, atol=2e-5)
    sampler = jax.jit(steered.sampler)()
    repeated = sampler.sample_actions(None, obs, noise=noise, **options)
    np.testing.assert_allclose(repeated, chunk, atol=2e-5)
    assert model.noise_actor is None
    plain = jax.jit(lambda: model.sample_actions(None, obs, noise=noise, **options))()
    assert np.abs(plain - chunk).max() > 1e-2


def test_without_a_shift_noise_of_an_exploring_actor_is_standard_normal(config):
    actor = NoiseActor.init(jax.random.key(0), config, std=STD, widths=(16,))
    drawn = [jax.random.normal(jax.random.key(i), (4000, 3, 2)) for i in range(2)]
    noise = np.asarray(actor.mixed(STD * drawn[0][:, 0], drawn[1]))
    assert noise.std() == pytest.approx(1, abs=0.02)
    common = np.corrcoef(noise[:, 0, 0], noise[:, 1, 0])[0, 1]
    assert common == pytest.approx(STD**2, abs=0.04)


def test_a_blank_actor_has_the_shapes_of_the_one_it_is_for(config, actor):
    blank = NoiseActor.blank(config, **actor.settings)
    assert jax.tree.structure(blank) == jax.tree.structure(actor)
    assert jax.tree.map(jnp.shape, blank) == jax.tree.map(jnp.shape, actor)


@pytest.mark.parametrize("change", [{"std": 1.0}, {"widths": [0]}, {"widths": [8] * 9}])
def test_absurd_settings_are_refused(config, actor, change):
    with pytest.raises(ValueError, match=re.escape("of a noise actor are out of range")):
        NoiseActor.blank(config, **actor.settings | change)
