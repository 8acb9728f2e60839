"""Continuing the previous chunk, trained and guided, and flow times per action."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.models import flow_matching, real_time_chunking
from lorasp_jax.models.flow_matching import Times
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig
from tests.models.random_models import observation, random_backbone

CONFIGS = {
    "pi0": Pi0Config.dummy(),
    "pi05": dataclasses.replace(Pi0Config.dummy(), pi05=True),
    "smolvla": SmolVLAConfig.dummy(),
}
BATCH, STEPS = 2, 3
SHAPE = (BATCH, CONFIGS["pi0"].chunk, CONFIGS["pi0"].action_dim)
NOISE, PREVIOUS = np.random.default_rng(0).normal(size=(2, *SHAPE)).astype(np.float32)


@pytest.fixture(scope="module", params=CONFIGS)
def model(request):
    return random_backbone(CONFIGS[request.param])


@pytest.fixture(scope="module")
def obs(model):
    return observation(model.config, BATCH)


@pytest.fixture(scope="module")
def sample(model, obs):
    """(prefix, d) -> chunk; d is traced, one for each row."""

    @jax.jit
    def sample(prefix, length):
        options = {"prefix": prefix, "prefix_length": length}
        return model.sampler().sample_actions(None, obs, num_steps=STEPS, noise=NOISE, **options)

    return lambda prefix, length: np.asarray(sample(prefix, np.broadcast_to(length, BATCH)))


def test_equal_times_per_action_are_one_time(model, obs):
    velocity, time = jax.jit(model.velocity), np.array([0.3, 0.9], np.float32)
    expected = np.asarray(velocity(obs, NOISE, time))
    times = np.repeat(time[:, None], SHAPE[1], axis=1)
    np.testing.assert_allclose(velocity(obs, NOISE, times), expected, atol=1e-5)
    times[0, 3] = 0.5
    other = np.asarray(velocity(obs, NOISE, times))
    assert np.abs(other - expected)[0, 3].max() > 1e-3
    np.testing.assert_allclose(other[1], expected[1], atol=1e-5)


def test_without_delay_sampling_is_as_without_prefix(model, obs, sample):
    plain = jax.jit(lambda m: m.sample_actions(None, obs, num_steps=STEPS, noise=NOISE))
    np.testing.assert_allclose(sample(PREVIOUS, 0), plain(model), atol=1e-5)


def test_a_trained_policy_continues_the_prefix(sample):
    """The chunk starts with the given actions; later ones depend on these, but on no others."""
    chunks = {d: sample(PREVIOUS, d) for d in range(SHAPE[1] + 1)}
    for d, chunk in chunks.items():
        np.testing.assert_array_equal(chunk[:, :d], PREVIOUS[:, :d])
        if d < SHAPE[1]:
            assert (chunk[:, d] != PREVIOUS[:, d]).any()
    index = np.arange(SHAPE[1])[:, None]
    np.testing.assert_array_equal(sample(PREVIOUS + (index >= 2), 2), chunks[2])
    assert (np.abs(sample(PREVIOUS + (index == 0), 2) - chunks[2])[:, 2:].max(-1) > 1e-4).all()


def test_each_row_may_have_its_own_delay(sample):
    found = sample(PREVIOUS, [1, 3])
    for row, d in enumerate((1, 3)):
        np.testing.assert_allclose(found[row], sample(PREVIOUS, d)[row], atol=1e-5)


def test_a_guided_chunk_equals_the_papers_algorithm():
    """Eqs. 1 to 5 in the paper's time, with gradients through the whole model."""
    model = random_backbone(CONFIGS["smolvla"])
    obs = observation(model.config, BATCH)
    overlap, d, beta = 3, 1, 2.0
    target = np.zeros(SHAPE, np.float32)
    target[:, :overlap] = PREVIOUS[:, :overlap]
    c = [(overlap - i) / (overlap - d + 1) for i in range(overlap)]
    decay = [c[i] * (math.e ** c[i] - 1) / (math.e - 1) for i in range(d, overlap)]
    weights = np.array([1.0] * d + decay + [0.0] * (SHAPE[1] - overlap), np.float32)

    @jax.jit
    def correction(actions, tau):
        time = jnp.full(BATCH, 1 - tau)
        estimate = lambda a: a - (1 - tau) * model.velocity(obs, a, time)  # noqa: E731
        value, vjp = jax.vjp(estimate, actions)
        return -model.velocity(obs, actions, time), vjp(weights[:, None] * (target - value))[0]

    actions = NOISE
    for tau in np.arange(STEPS) / STEPS:
        v, gradient = correction(actions, tau)
        r2 = (1 - tau) ** 2 / (tau**2 + (1 - tau) ** 2)
        weight = min(beta, (1 - tau) / (tau * r2)) if tau else beta
        actions = actions + (v + weight * gradient) / STEPS
    options = {"prefix": PREVIOUS[:, :overlap], "prefix_length": d, "guidance": beta}
    found = jax.jit(
        lambda: model.sample_actions(None, obs, num_steps=STEPS, noise=NOISE, **options)
    )()
    np.testing.assert_allclose(found, actions, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("limit", [0.5, 5.0])
def test_guidance_of_a_linear_velocity_in_float64(limit):
    """v = M x + t, whose Jacobian is M, over the flattened chunk; some slots are unused."""
    rng, steps, overlap, d = np.random.default_rng(0), 7, 3, 2
    shape = (1, 4, 3)
    matrix, slots = 0.3 * rng.normal(size=(12, 12)), np.array([True, False, True])
    noise, previous = rng.normal(size=(2, *shape))
    flat = jnp.asarray(matrix, jnp.float32)

    def velocity(x_t, time):
        return (flat @ x_t.reshape(12)).reshape(shape) + time[:, None, None], None

    options = {"guidance": limit, "num_steps": steps, "slots": slots}
    run = jax.jit(functools.partial(real_time_chunking.sample, velocity, **options))
    prefix = jnp.asarray(previous[:, :overlap])
    found, _ = run(jnp.asarray(noise), prefix=prefix, length=jnp.int32(d))
    used = np.tile(slots, 4)
    weights = np.repeat([1, 1, 0.5 * (math.e**0.5 - 1) / (math.e - 1), 0], 3) * used
    x = noise.reshape(12) * used
    for t in 1 - np.arange(steps) / steps:
        v = matrix @ x + t
        error = weights * (previous.reshape(12) - (x - t * v))
        gradient = (np.eye(12) - t * matrix).T @ error
        weight = min(limit, (t**2 + (1 - t) ** 2) / (t * (1 - t))) if t < 1 else limit
        x = (x - (v - weight * gradient) / steps) * used
    np.testing.assert_allclose(np.asarray(found).reshape(12), x, atol=1e-5)


def test_soft_mask():
    """Ones, a decay from below one to above zero, zeros; a hard mask if nothing else overlaps."""
    soft_mask = jax.jit(real_time_chunking.soft_mask, static_argnums=(1, 2))
    mask = np.asarray(soft_mask(np.array([0, 2, 6]), 6, 8))
    np.testing.assert_array_equal(mask[1, :2], 1)
    np.testing.assert_array_equal(mask[:, 6:], 0)
    assert (np.diff(mask[0, :7]) < 0).all()
    assert 0 < mask[0, 5] < mask[0, 0] < 1
    np.testing.assert_array_equal(mask[2, :6], 1)


def test_times_of_training():
    """The first d actions have time 0, with d uniform; without a delay, there is one time a row."""
    data = np.random.default_rng(0).normal(size=(3000, 5, 2)).astype(np.float32)

    @jax.jit
    def draw(key, data):
        without, (noise, times) = (
            flow_matching.draw(key, data, Times(max_delay=d)) for d in (0, 3)
        )
        return without, noise, times, flow_matching.interpolate(noise, data, times)[0]

    (noise, time), same_noise, times, x_t = jax.device_get(draw(jax.random.key(0), data))
    assert time.shape == (3000,)
    np.testing.assert_array_equal(noise, same_noise)
    delay = (times == 0).sum(1)
    np.testing.assert_allclose(np.bincount(delay, minlength=6)[:4] / 3000, 0.25, atol=0.03)
    assert delay.max() == 3
    expected = np.where(np.arange(5) < delay[:, None], 0, time[:, None])
    np.testing.assert_array_equal(times, expected)
    np.testing.assert_array_equal((x_t == data).all(2), expected == 0)


def test_wrong_prefixes_are_refused():
    options = {"length": jnp.int32(0), "guidance": None, "num_steps": 1}
    for shape in ((BATCH, 5, 8), (BATCH, 0, 8), (1, 4, 8), (BATCH, 4, 7)):
        with pytest.raises(ValueError, match=r"prefix must be \(2, 1 to 4, 8\)"):
            real_time_chunking.sample(None, NOISE, prefix=jnp.zeros(shape), **options)
