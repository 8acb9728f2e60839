"""Held-out observations: demonstrations that no cell trains on."""

import dataclasses
import functools
from collections.abc import Callable, Mapping

import jax
import numpy as np

from envs.datasets.episodes import Episodes
from lorasp_jax.config import Config
from lorasp_jax.data.batches import Batch, encode, flatten, gather
from lorasp_jax.policies.policy import Policy

EPISODES = 32
"""Held-out episodes per task."""
SEED = 2**32 - 1
"""Seed of the held-out episodes; no cell may have it."""

Sample = Callable[[jax.Array], Batch]
"""Returns the batch of a random key."""

_encode = functools.partial(jax.jit, static_argnames="state_noise")(encode)


def settings(config: Config) -> Config:
    """Return the config whose demonstrations are the held-out episodes of a run.

    Raises:
        ValueError: the run has the seed of the held-out episodes.
    """
    if config.seed == SEED:
        raise ValueError(f"seed {SEED} is reserved for held-out episodes")
    data = dataclasses.replace(config.data, source="", fresh_every=0, episodes=EPISODES)
    return dataclasses.replace(config, data=data, seed=SEED)


def sampler(policy: Policy, episodes: Episodes, batch_size: int) -> Sample:
    """Return a function from a key to a batch of windows that start at random steps of `episodes`.

    Unlike in training, the state has no noise.

    Raises:
        ValueError: the policy has no prompt for one of the instructions.
    """
    processor, chunk = policy.processor, policy.model.config.chunk
    rows = processor.prompts.rows(episodes.instructions)
    steps = flatten([episodes])
    steps = dataclasses.replace(steps, instruction=rows[steps.instruction])

    def sample(key: jax.Array) -> Batch:
        start_key, noise_key = jax.random.split(key)
        start = np.asarray(jax.random.randint(start_key, (batch_size,), 0, len(steps.end)))
        return _encode(noise_key, gather(steps, start, chunk), processor, state_noise=0.0)

    return sample


def keyed_batches(
    policy: Policy, episodes: Mapping[str, Episodes], batch_size: int, batches: int
) -> dict[str, list[tuple[jax.Array, Batch]]]:
    """Return a fixed number of batches by task, each with a key for the noise of its loss.

    All tasks have the same keys.
    """
    keys = jax.random.split(jax.random.key(0), (batches, 2))
    found = {}
    for task, group in episodes.items():
        sample = sampler(policy, group, batch_size)
        found[task] = [(loss_key, sample(batch_key)) for batch_key, loss_key in keys]
    return found
