"""Random streams of a run, with independent keys derived from the run's seed."""

import enum
import zlib
from typing import NamedTuple

import jax
import numpy as np


@enum.unique
class RandomStream(enum.IntEnum):
    """Purposes of random numbers. Changing a value changes the results of every run."""

    DEMONSTRATIONS = 1
    TRAINING = 2
    ADAPTERS = 3
    BASE = 4
    STATISTICS = 5
    # 6 is retired: a new purpose gets a number that no run has used.
    CRITIC = 7
    ROLLOUTS = 8
    """Episodes of online reinforcement learning."""
    TEACHER = 14
    NOISE_ACTOR = 15
    EVALUATION = 10
    """Evaluations before and during training."""
    FINAL_EVALUATION = 11
    CONDITION = 13
    """Steps of which a policy is not told whether they are good."""
    RECORDING = 12
    """Recorded episodes of a policy; the seed is not the run's."""

    def key(self, seed: int, name: str = "") -> jax.Array:
        """Return the key of the stream, or of its part `name`, such as a task."""
        key = jax.random.fold_in(jax.random.key(seed), self)
        # Python's hash of a string differs between processes.
        return jax.random.fold_in(key, np.uint32(zlib.crc32(name.encode()))) if name else key


class StepKeys(NamedTuple):
    """Keys of one training step: for its windows, the noise of the state, the loss, the images."""

    windows: jax.Array
    state_noise: jax.Array
    loss: jax.Array
    images: jax.Array

    @classmethod
    def of(cls, key: jax.Array, step: jax.Array) -> "StepKeys":
        """Derive the keys of step `step`, `[]` int32, from the key of `RandomStream.TRAINING`."""
        key = jax.random.fold_in(key, step)
        batch, loss = jax.random.split(key)
        windows, state_noise = jax.random.split(batch)
        images = jax.random.fold_in(key, 2)  # with 0 and 1 it would be a key of the split
        return cls(windows, state_noise, loss, images)
