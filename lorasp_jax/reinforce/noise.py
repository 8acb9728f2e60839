"""Exploration: Gaussian noise around the chunk that the deterministic sampler would return.

Given an observation o and the initial noise ε of the flow, the chunk of the sampler is a function
μ(o, ε). The policy that explores executes actions from N(μ, s² I), so that the probability of an
action is exact with any number of flow steps, and the sampler without noise is its mean. Its noise
depends on no parameter.
"""

import jax
import jax.numpy as jnp
import numpy as np

from lorasp_jax.models import flow_matching
from lorasp_jax.models.backbone import Backbone
from lorasp_jax.models.transformer.layers import ModelAux, merge_action_aux
from lorasp_jax.policies.processor import Processor, RawObservation


def action_slots(processor: Processor) -> np.ndarray:
    """Return the mask of the slots that the robot executes, `[A]` bool: only these get noise."""
    return np.isin(np.arange(processor.statistics.dim), processor.action_slots)


def explore(
    key: jax.Array, mean: jax.Array, std: float | jax.Array, slots: np.ndarray
) -> jax.Array:
    """Draw actions `[..., A]` around their means; do not reuse `key`."""
    return mean + std * jax.random.normal(key, mean.shape) * slots


def log_prob(
    mean: jax.Array, actions: jax.Array, std: float | jax.Array, slots: np.ndarray
) -> jax.Array:
    """Return the log-density `[...]` of actions `[..., A]` in the executed slots."""
    z = jnp.where(slots, (actions - mean) / std, 0)
    normalizer = slots.sum() * (jnp.log(std) + 0.5 * np.log(2 * np.pi))
    return -0.5 * jnp.sum(jnp.square(z), axis=-1) - normalizer


def divergence(
    mean: jax.Array, other: jax.Array, std: float | jax.Array, slots: np.ndarray
) -> jax.Array:
    """Return the KL divergence `[...]` between the distributions around two means `[..., A]`."""
    return 0.5 * jnp.sum(jnp.square(jnp.where(slots, (mean - other) / std, 0)), axis=-1)


def means(
    model: Backbone,
    processor: Processor,
    observation: RawObservation,
    prompts: jax.Array,
    noise: jax.Array,
    num_steps: int,
) -> tuple[jax.Array, ModelAux]:
    """Return the sampler's normalized chunk, differentiable, and the adapters' aux.

    Args:
        model: the adapted model, not its sampler.
        processor: the robot's.
        observation: from `env.observe`, B rows.
        prompts: `[B]` int32, rows of the processor's prompt table.
        noise: `[B, C, A]` initial noise of the flow.
        num_steps: Euler steps.

    Returns:
        `[B, C, A]` f32, equal to `sample_actions` up to rounding.
    """
    obs = processor.encode(observation, prompts)
    prefix, aux = model.run_prefix(obs)
    chunk, action_aux = flow_matching.sample(
        lambda x_t, t: model.run_suffix(prefix, obs, x_t, t),
        noise,
        num_steps=num_steps,
        slots=jnp.asarray(processor.flow_slots),
    )
    return chunk, merge_action_aux(aux, jax.tree.map(lambda x: x[-1], action_aux))
