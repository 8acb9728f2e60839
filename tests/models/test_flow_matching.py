import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.models import flow_matching

SHAPE = (2, 3, 4)
NOISE = jax.random.normal(jax.random.key(0), SHAPE)
DATA = jax.random.normal(jax.random.key(1), SHAPE)


def test_time_one_is_noise_and_zero_is_data():
    ones = jnp.ones(2)
    np.testing.assert_array_equal(flow_matching.interpolate(NOISE, DATA, ones)[0], NOISE)
    x_0, u_t = flow_matching.interpolate(NOISE, DATA, 0 * ones)
    np.testing.assert_array_equal(x_0, DATA)
    np.testing.assert_array_equal(u_t, NOISE - DATA)


@pytest.mark.parametrize("shape", [1.5, 4.0])
def test_time_distribution(shape):
    """Beta(a, 1) has mean a / (a + 1) and CDF t^a."""
    time = flow_matching.sample_time(jax.random.key(2), 20_000, shape)
    assert time.min() >= 0.001
    assert time.max() <= 1
    np.testing.assert_allclose(time.mean(), shape / (shape + 1) * 0.999 + 0.001, atol=0.01)
    np.testing.assert_allclose((time < 0.5).mean(), 0.5**shape, atol=0.015)


def test_loss_is_zero_only_for_the_true_velocity():
    right = lambda x_t, time: (NOISE - DATA, "aux")  # noqa: E731
    per_element, aux = flow_matching.loss(right, jax.random.key(3), DATA, noise=NOISE)
    assert aux == "aux"
    assert per_element.shape == SHAPE
    assert not per_element.any()
    wrong = lambda x_t, time: (NOISE - DATA + 2, None)  # noqa: E731
    np.testing.assert_allclose(
        flow_matching.loss(wrong, jax.random.key(3), DATA, noise=NOISE)[0], 4, rtol=1e-5
    )


def test_euler_steps():
    """A constant velocity leads back to the data; times are 1 - k / n."""
    sampled, times = flow_matching.sample(lambda x, t: (NOISE - DATA, t), NOISE, num_steps=10)
    np.testing.assert_allclose(sampled, DATA, atol=1e-5)
    np.testing.assert_allclose(times[:, 0], 1 - np.arange(10) / 10, atol=1e-6)


def test_unused_slots_stay_zero():
    slots = jnp.array([True, True, False, True])
    inputs = []
    flow_matching.loss(
        lambda x_t, t: (inputs.append(x_t) or x_t, None), jax.random.key(4), DATA, slots=slots
    )
    assert not inputs[0][..., 2].any()
    assert inputs[0][..., 3].all()
    sampled, _ = flow_matching.sample(lambda x, t: (x + 5, None), NOISE, num_steps=3, slots=slots)
    assert not sampled[..., 2].any()
