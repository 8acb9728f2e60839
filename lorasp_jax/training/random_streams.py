"""Random streams of a run, with independent keys derived from the run's seed."""

import enum

import jax


@enum.unique
class RandomStream(enum.IntEnum):
    """Purposes of random numbers. Changing a value changes the results of every run."""

    DEMONSTRATIONS = 1
    TRAINING = 2
    ADAPTERS = 3
    BASE = 4
    STATISTICS = 5
    EVALUATION = 10
    """Must stay the largest value: evaluation n uses 10 + n."""

    def key(self, seed: int, number: int = 0) -> jax.Array:
        """Return the key of the stream; `number` is the index of an evaluation, 0 otherwise."""
        return jax.random.fold_in(jax.random.key(seed), self + number)
