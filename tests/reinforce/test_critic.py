"""Advantages, against sums written out."""

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.reinforce import critic
from lorasp_jax.reinforce.config import Learning
from lorasp_jax.reinforce.critic import Critic
from lorasp_jax.reinforce.rollout import Transitions

DISCOUNT, TRACE = 0.9, 0.8


def test_generalized_advantages_are_sums_of_errors():
    rng = np.random.default_rng(0)
    values, reward = rng.normal(size=(2, 6, 1))
    last, ended = np.array([0.7]), np.array([[0], [0], [1], [0], [0], [0]], bool)
    found = critic.generalized_advantages(
        jnp.array(values), jnp.array(last), jnp.array(reward), jnp.array(ended), DISCOUNT, TRACE
    )[:, 0]
    v, r = [*values[:, 0], last[0]], reward[:, 0]
    error = [r[t] + DISCOUNT * (0 if ended[t, 0] else v[t + 1]) - v[t] for t in range(6)]
    decay = DISCOUNT * TRACE
    first = error[0] + decay * error[1] + decay**2 * error[2]  # the episode ends here
    fourth = error[3] + decay * error[4] + decay**2 * error[5]  # this one goes on
    np.testing.assert_allclose(found[jnp.array([0, 2, 3])], [first, error[2], fourth], rtol=1e-5)


def test_a_critic_learns_the_returns():
    """Reward 1 after one step if the state is positive."""
    state = jax.random.normal(jax.random.key(0), (4, 512, 3))
    ended, done = jnp.ones((4, 512), bool), jnp.zeros((4, 512), bool)
    reward = (state[..., 0] > 0).astype(jnp.float32)
    steps, model = (
        Transitions(state, done, ended, done, reward),
        Critic.init(jax.random.key(1), 3, 1e-2),
    )
    learning = Learning(discount=DISCOUNT, trace=TRACE, critic_learning_rate=1e-2)
    learn = jax.jit(critic.learn, static_argnums=4)
    keys = jax.random.split(jax.random.key(2), 20)
    for number in range(20):
        advantages, model, metrics = learn(model, steps, state[0], keys[number], learning)
    assert metrics["explained_variance"] > 0.8
    assert jnp.abs(model(jnp.array([[2.0, 0, 0], [-2.0, 0, 0]])) - jnp.array([1, 0])).max() < 0.1
    np.testing.assert_allclose([advantages.mean(), advantages.std()], [0, 1], atol=1e-3)
    np.testing.assert_allclose(model.network.mean, state.mean((0, 1)), atol=1e-5)


def failures(state):
    """Return steps of one-step episodes that all fail."""
    done = jnp.zeros(state.shape[:2], bool)
    return Transitions(state, done, ~done, done, jnp.zeros(state.shape[:2]))


def learn(state):
    model = Critic.init(jax.random.key(1), 3, 1e-3)
    return critic.learn(model, failures(state), state[0], jax.random.key(2), Learning())


def test_noise_of_the_critic_is_not_scaled_to_advantages():
    advantages, _, _ = learn(jax.random.normal(jax.random.key(0), (4, 128, 3)))
    assert 0 < advantages.std() < 0.5


def test_states_that_are_not_finite_teach_the_critic_nothing():
    state = jax.random.normal(jax.random.key(0), (4, 128, 3))
    state = state.at[1, 2, 0].set(jnp.nan).at[0, 3, 1].set(jnp.inf)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(learn(state)))
