"""A critic on the simulator's full state, and the advantages that follow.

It sees what the policy cannot see, since it is thrown away after training (asymmetric actor-critic,
arXiv 1710.06542), and uses no adapters.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import optax

from lorasp_jax.reinforce.config import Learning
from lorasp_jax.reinforce.rollout import Transitions

_WIDTH, _BATCH, _EPOCHS = 128, 512, 4  # our choice
_LIMIT = 5.0
"""Normalized states are clipped to this magnitude."""
_LEAST = 0.05
"""Advantages are divided by their standard deviation, but not by less: this would scale noise."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Critic:
    """Predicts the return of a state of one task.

    Attributes:
        layers: weights and biases of an MLP.
        mean, std: `[D]` of the first iteration's states, which normalize its inputs.
    """

    layers: list[tuple[jax.Array, jax.Array]]
    opt_state: Any
    mean: jax.Array
    std: jax.Array

    @classmethod
    def init(cls, key: jax.Array, size: int, rate: float) -> "Critic":
        """Create a critic of states `[D]`, D = `size`, which predicts about 0."""
        sizes, scales = (size, _WIDTH, _WIDTH, 1), (1.4, 1.4, 0.01)
        layers = [
            (jax.nn.initializers.orthogonal(scale)(k, (i, o)), jnp.zeros(o))
            for k, scale, i, o in zip(
                jax.random.split(key, 3), scales, sizes[:-1], sizes[1:], strict=True
            )
        ]
        return cls(layers, optax.adam(rate).init(layers), jnp.zeros(size), jnp.zeros(size))

    def __call__(self, state: jax.Array) -> jax.Array:
        """Predict the returns `[...]` of states `[..., D]`."""
        x = jnp.clip((state - self.mean) / (self.std + 1e-3), -_LIMIT, _LIMIT)
        return _apply(self.layers, x)


def _apply(layers: list[tuple[jax.Array, jax.Array]], x: jax.Array) -> jax.Array:
    for weight, bias in layers[:-1]:
        x = jnp.tanh(x @ weight + bias)
    return (x @ layers[-1][0] + layers[-1][1])[..., 0]


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
    running = ~steps.done
    states, last = (jnp.nan_to_num(x, posinf=0.0, neginf=0.0) for x in (steps.state, last))
    moment = lambda x: jnp.sum(x * running[..., None], (0, 1)) / jnp.sum(running)  # noqa: E731
    mean = moment(states)
    std = jnp.sqrt(moment(jnp.square(states - mean)))
    new = jnp.all(critic.std == 0)
    mean, std = jnp.where(new, mean, critic.mean), jnp.where(new, std, critic.std)
    critic = dataclasses.replace(critic, mean=mean, std=std)
    values = critic(states)
    outcome = steps.reward, steps.ended, learning.discount, learning.trace
    advantages = generalized_advantages(values, critic(last), *outcome)
    targets = advantages + values
    fitted, errors = _fit(critic, (states, targets, running), key, learning.critic_learning_rate)
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
            predicted = Critic(layers, None, critic.mean, critic.std)(states[rows])
            return jnp.mean(jnp.square(predicted - targets[rows]))

        error, gradient = jax.value_and_grad(loss)(layers)
        updates, opt_state = optimizer.update(gradient, opt_state)
        return (optax.apply_updates(layers, updates), opt_state), error

    learned, count = (critic.layers, critic.opt_state), -(-_EPOCHS * len(states) // _BATCH)
    (layers, opt_state), errors = jax.lax.scan(step, learned, jax.random.split(key, count))
    return Critic(layers, opt_state, critic.mean, critic.std), errors
