"""The update of a small policy on the calls of one iteration, by proximal policy optimization."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from lorasp_jax.models.perceptron import Network
from lorasp_jax.reinforce import noise
from lorasp_jax.reinforce.surrogate import Samples, adapted, clipped_surrogate


class Descent(NamedTuple):
    """Settings of an update.

    Attributes:
        learning_rate: that the factor of the state multiplies.
        epochs: passes over the calls.
        size: calls of a gradient step.
        clip: see `clipped_surrogate`.
        max_kl: a divergence of the calls above it ends the update.
    """

    learning_rate: float
    epochs: int
    size: int
    clip: float
    max_kl: float


class Learned(NamedTuple):
    """A network that learns, the state of its optimizer, and the factor `[]` of its rate."""

    network: Network
    opt_state: Any
    rate: jax.Array


def optimizer() -> optax.GradientTransformation:
    """Return Adam without a learning rate; gradients are clipped to norm 1."""
    return optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam())


def improve(
    learned: Learned,
    inputs: jax.Array,
    samples: Samples,
    key: jax.Array,
    spread: noise.Spread,
    slots: np.ndarray,
    settings: Descent,
) -> tuple[Learned, dict[str, jax.Array]]:
    """Take gradient steps on minibatches of calls until the policy has changed enough.

    A step whose gradient is not finite is the last, too.

    Args:
        learned: before the update.
        inputs: `[N, D]` of the network.
        samples: of the N calls.
        key: orders the calls.
        spread: of the noise with which the policy acted.
        slots: `[A]` bool, the executed ones.
        settings: of the update.

    Returns:
        The result, and metrics `[steps]`; `taken` says which steps were.
    """
    network, size = learned.network, min(settings.size, len(inputs))

    def step(carry: Any, index: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
        layers, opt_state, within, kl = carry
        seen, rows = jax.tree.map(lambda x: x[index], (inputs, samples))

        def loss(layers: Any) -> tuple[jax.Array, Any]:
            mean = dataclasses.replace(network, layers=layers)(seen)
            mean = mean.reshape(rows.mean.shape)
            return clipped_surrogate(mean, rows, spread, slots, settings.clip)

        (value, metrics), gradient = jax.value_and_grad(loss, has_aux=True)(layers)
        norm = optax.tree.norm(gradient)
        kl = jnp.where(within, metrics["kl"], kl)
        within &= (metrics["kl"] <= settings.max_kl) & jnp.isfinite(norm)
        updates, after = optimizer().update(gradient, opt_state)
        rate = -settings.learning_rate * learned.rate
        moved = optax.apply_updates(layers, jax.tree.map(lambda x: rate * x, updates))
        new, old = (moved, after), (layers, opt_state)
        chosen = jax.tree.map(lambda x, y: jnp.where(within, x, y), new, old)
        return (*chosen, within, kl), metrics | {"loss": value, "grad_norm": norm, "taken": within}

    keys = jax.random.split(key, settings.epochs)
    orders = [jax.random.permutation(k, len(inputs)) for k in keys]
    batches = jnp.concatenate([x[: len(x) // size * size].reshape(-1, size) for x in orders])
    first = network.layers, learned.opt_state, jnp.bool_(True), jnp.zeros(())
    (layers, opt_state, _, kl), metrics = jax.lax.scan(step, first, batches)
    network = dataclasses.replace(network, layers=layers)
    return Learned(network, opt_state, adapted(learned.rate, kl, settings.max_kl)), metrics
