"""Batches of demonstrations that do not depend on training, for calibration and comparison."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax

from envs.datasets.episodes import Episodes
from lorasp_jax.data.batches import Batch, flatten, sample_batch
from lorasp_jax.policies.policy import Policy
from lorasp_jax.training.demonstrations import Demonstrations

Sample = Callable[[jax.Array], Batch]
"""Returns the batch of a random key."""
Keyed = tuple[jax.Array, Batch]
"""A batch with the key of its loss."""

_SIZES = ("batch_size", "chunk", "state_noise")
sample = jax.jit(sample_batch, static_argnames=_SIZES)  # seeds share its programs


def sampler(policy: Policy, episodes: Episodes, batch_size: int) -> Sample:
    """Return a function from a key to a batch of windows that start at random steps of `episodes`.

    Unlike in training, the state has no noise.

    Raises:
        ValueError: the policy has no prompt for one of the instructions.
    """
    rows, steps = policy.processor.prompts.rows(episodes.instructions), flatten([episodes])
    steps = jax.device_put(dataclasses.replace(steps, instruction=rows[steps.instruction]))
    sizes = {"batch_size": batch_size, "chunk": policy.model.config.chunk, "state_noise": 0.0}
    return lambda key: sample(key, steps, policy.processor, **sizes)


def keyed_batches(
    policy: Policy, episodes: Demonstrations, batch_size: int, batches: int
) -> dict[str, list[Keyed]]:
    """Return a fixed number of batches by task, each with a key for the noise of its loss.

    All tasks have the same keys.
    """
    keys = jax.random.split(jax.random.key(0), (batches, 2))
    found = {}
    for task, group in episodes.items():
        sample = sampler(policy, group, batch_size)
        found[task] = [(loss_key, sample(batch_key)) for batch_key, loss_key in keys]
    return found


def forward(model: Any, keyed: Keyed) -> Any:
    """Return the model's loss per action element and its auxiliary values on a batch."""
    key, batch = keyed
    return model.loss(key, batch.observation, batch.actions, action_mask=batch.action_mask)
