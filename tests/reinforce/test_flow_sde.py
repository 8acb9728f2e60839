"""Exploration in the flow, with the exact velocity of a normal distribution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from lorasp_jax.models import flow_matching
from lorasp_jax.reinforce import flow_sde, noise
from lorasp_jax.reinforce.config import Learning

LEVEL, MEAN = 0.5, 0.3
TABLE = {  # K: standard deviations of the steps' noise, computed apart from this code
    4: [0.5, 0.433, 0.25, 0.144],
    5: [0.5, 0.447, 0.274, 0.183, 0.112],
}


def flow(std):
    """The velocity of N(MEAN, std²) in every entry."""

    def velocity(x, flow_time):
        t = flow_time[:, None, None]
        z = (x - (1 - t) * MEAN) / (t**2 + (1 - t) ** 2 * std**2)
        return t * z - (MEAN + (1 - t) * std**2 * z), None

    return velocity


def initial(count, *shape):
    return jax.random.normal(jax.random.key(1), (count, *shape))


@pytest.mark.parametrize("count", TABLE)
def test_log_probabilities_are_those_of_a_normal_distribution(count):
    spread = flow_sde.spread_of(jnp.arange(count), count, LEVEL)
    np.testing.assert_allclose(spread.std[:, 0], TABLE[count], atol=5e-4)
    grid = np.linspace(-4, 5, 2001, dtype=np.float32)
    mean = 0.2 + 0.1 * np.arange(count)
    inputs = jnp.array(mean, jnp.float32)[:, None, None], jnp.array(grid)[:, None, None, None]
    found = noise.log_prob(*inputs, spread, np.ones(1, bool))[..., 0]
    expected = stats.norm.logpdf(grid[:, None], mean, spread.std[:, 0])
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
    density = np.trapezoid(np.exp(found), grid, axis=0)
    np.testing.assert_allclose(density, 1, atol=1e-4)


def integrate(std, count, level=LEVEL, samples=100_000):
    """Make every step stochastic."""

    def step(x, index):
        key = jax.random.fold_in(jax.random.key(2), index)
        k = jnp.full(len(x), index)
        v, _ = flow(std)(x, 1 - k / count)
        scale = flow_sde.spread_of(k, count, level).std[..., None]
        mean = x - flow_sde.drift(x, v, k, count, level) / count
        return mean + scale * jax.random.normal(key, x.shape), None

    return jax.lax.scan(step, initial(samples, 1, 1), jnp.arange(count))[0]


@pytest.mark.parametrize(
    ("count", "std", "ode", "sde"),
    [
        *[(4, 0.02, 0.001, 0.154), (5, 0.02, 0.002, 0.118), (10, 0.02, 0.004, 0.054)],
        *[(4, 0.1, 0.028, 0.145), (5, 0.1, 0.036, 0.112), (10, 0.1, 0.062, 0.081)],
    ],
)
def test_few_steps_change_the_spread_of_actions(count, std, ode, sde):
    assert float(integrate(std, count, 0.0).std()) == pytest.approx(ode, abs=6e-4)
    assert float(integrate(std, count).std()) == pytest.approx(sde, abs=1.5e-3)


@pytest.mark.parametrize("std", [0.1, 0.5])
def test_many_steps_keep_the_distribution(std):
    found = np.asarray(integrate(std, 1000, samples=20_000)).ravel()
    assert stats.kstest(found, stats.norm(MEAN, std).cdf).statistic < 0.015


def sample(std, count, level=LEVEL, samples=20_000, key=3):
    noisy = np.zeros((3, 2), bool)
    noisy[:2, 0] = True
    inputs = jax.random.key(key), flow(std), initial(samples, 3, 2), noisy, level
    chunk, taken = flow_sde.sample(*inputs, num_steps=count, slots=np.ones(2, bool))
    return noisy, chunk, taken


def test_a_world_takes_one_stochastic_step():
    noisy, chunk, (x, after, step) = sample(0.1, 4)
    assert stats.chisquare(np.bincount(step, minlength=4)).pvalue > 1e-3
    v, _ = flow(0.1)(x, 1 - step / 4)
    mean = x - flow_sde.drift(x, v, step, 4, LEVEL) / 4
    z = (after - mean) / flow_sde.spread_of(step, 4, LEVEL).std[..., None]
    for k in range(4):
        assert stats.kstest(z[step == k][:, noisy].ravel(), "norm").pvalue > 1e-3, k
    np.testing.assert_allclose(after[:, ~noisy], (x - v / 4)[:, ~noisy], atol=1e-6)
    for k in range(4):  # the other steps are those of the ODE
        before, ended = initial(len(x), 3, 2), after
        for other in range(4):
            at = jnp.full(len(x), 1 - other / 4)
            if other < k:
                before -= flow(0.1)(before, at)[0] / 4
            if other > k:
                ended -= flow(0.1)(ended, at)[0] / 4
        np.testing.assert_allclose(x[step == k], before[step == k], atol=1e-5)
        np.testing.assert_allclose(chunk[step == k], ended[step == k], atol=1e-5)


def test_one_step_of_four_explores_less_than_all():
    noisy, chunk, _ = sample(0.02, 4, samples=100_000)
    assert float(chunk[:, noisy].std()) == pytest.approx(0.075, abs=2e-3)


def test_without_noise_it_is_the_deterministic_sampler():
    _, chunk, _ = sample(0.1, 4, level=0.0)
    expected, _ = flow_matching.sample(flow(0.1), initial(len(chunk), 3, 2), num_steps=4)
    np.testing.assert_allclose(chunk, expected, atol=1e-6)


def test_the_config_names_the_level():
    learning = Learning(method="ppo", exploration="sde", noise_level=0.3)
    assert noise.Spread.of(learning) == (0.3, 0.0)
