"""A critic on the simulator's full state, and the advantages that follow.

It sees what the policy cannot see, since it is thrown away after training (asymmetric actor-critic,
arXiv 1710.06542), and uses no adapters.
"""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import optax

from lorasp_jax.models.perceptron import Network, moments
from lorasp_jax.reinforce.config import Learning
from lorasp_jax.reinforce.rollout import Transitions

_WIDTHS, _BATCH, _EPOCHS = (128, 128), 512, 4  # our choice
_LEAST = 0.05
"""Advantages are divided by their standard deviation, but not by less: this would scale noise."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Critic:
    """Predicts the return of a state of one task; the first states normalize its inputs."""

    network: Network
    opt_state: Any

    @classmethod
    def init(cls, key: jax.Array, size: int, rate: float) -> "Critic":
        """Create a critic of states `[D]`, D = `size`, which predicts about 0."""
        network = Network.init(key, (size, *_WIDTHS), ())
        return cls(network, optax.adam(rate).init(network.layers))

    def __call__(self, state: jax.Array) -> jax.Array:
        """Predict the returns `[...]` of states `[..., D]`."""
        return self.network(state)


def generalized_advantages(
    values: jax.Array,
    last: jax.Array,
    reward: jax.Array,
    ended: jax.Array,
    discount: float,
    trace: float,
) -> jax.Array:
    """Return generalized advantages `[T, W]`; the time limit ends an episode as success does.

    Args:
        values: `[T, W]` before each step.
        last: `[W]`, after the last step.
        reward: `[T, W]`.
        ended: `[T, W]` bool, whether the episode was over after the step.
        discount: γ.
        trace: λ.
    """
    after = jnp.concatenate([values[1:], last[None]])
    errors = reward + discount * jnp.where(ended, 0, after) - values

    def body(later: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        error, ended = step
        total = error + discount * trace * jnp.where(ended, 0, later)
        return total, total

    return jax.lax.scan(body, jnp.zeros_like(last), (errors, ended), reverse=True)[1]


def learn(
    critic: Critic, steps: Transitions, last: jax.Array, key: jax.Array, learning: Learning
) -> tuple[jax.Array, Critic, dict[str, jax.Array]]:
    """Return advantages of steps, the critic after learning from the steps, and metrics.

    The critic learns to predict returns with λ; the advantages are those before it learned.

    Args:
        critic: of the task.
        steps: T steps in W worlds.
        last: `[W, D]`, the full state after them.
        key: chooses the states of the critic's steps.
        learning: γ, λ and the critic's learning rate.

    Returns:
        `[T, W]` advantages, of mean 0 and variance at most 1 where an episode runs, else 0.
    """
    running, network = ~steps.done, critic.network
    mean, std = moments(steps.state, running)
    new = jnp.all(network.std == 0)
    mean, std = jnp.where(new, mean, network.mean), jnp.where(new, std, network.std)
    critic = Critic(dataclasses.replace(network, mean=mean, std=std), critic.opt_state)
    values = critic(steps.state)
    outcome = steps.reward, steps.ended, learning.discount, learning.trace
    advantages = generalized_advantages(values, critic(last), *outcome)
    targets = advantages + values
    fitted, errors = _fit(
        critic, (steps.state, targets, running), key, learning.critic_learning_rate
    )
    variance = lambda x: jnp.var(x, where=running)  # noqa: E731
    metrics = {
        "critic_error": jnp.mean(errors),
        "explained_variance": 1 - variance(targets - values) / (variance(targets) + 1e-8),
    }
    centered = advantages - jnp.mean(advantages, where=running)
    scaled = centered / jnp.maximum(jnp.std(advantages, where=running), _LEAST)
    return jnp.where(running, scaled, 0), fitted, metrics


def _fit(
    critic: Critic, data: tuple[jax.Array, ...], key: jax.Array, rate: float
) -> tuple[Critic, jax.Array]:
    """Fit states `[T, W, D]` to targets `[T, W]` where a mask is set; return the errors, too."""
    optimizer = optax.adam(rate)
    states, targets, running = (x.reshape(-1, *x.shape[2:]) for x in data)

    def step(carry: tuple[Any, Any], key: jax.Array) -> tuple[Any, jax.Array]:
        layers, opt_state = carry
        rows = jax.random.choice(key, len(states), (_BATCH,), p=running / jnp.sum(running))

        def loss(layers: Any) -> jax.Array:
            predicted = dataclasses.replace(critic.network, layers=layers)(states[rows])
            return jnp.mean(jnp.square(predicted - targets[rows]))

        error, gradient = jax.value_and_grad(loss)(layers)
        updates, opt_state = optimizer.update(gradient, opt_state)
        return (optax.apply_updates(layers, updates), opt_state), error

    learned, count = (critic.network.layers, critic.opt_state), -(-_EPOCHS * len(states) // _BATCH)
    (layers, opt_state), errors = jax.lax.scan(step, learned, jax.random.split(key, count))
    return Critic(dataclasses.replace(critic.network, layers=layers), opt_state), errors


jitted_learn = functools.partial(jax.jit, static_argnums=4)(learn)
