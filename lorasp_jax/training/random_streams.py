"""The random streams of a run: each is a key of its own, derived from the run's one seed."""

import enum

import jax


@enum.unique
class RandomStream(enum.IntEnum):
    """What a run draws at random. A changed number changes the results of every run."""

    DEMONSTRATIONS = 1
    TRAINING = 2
    ADAPTERS = 3
    BASE = 4
    STATISTICS = 5
    EVALUATION = 10
    """The last one: number n of `key` has 10 + n."""

    def key(self, seed: int, number: int = 0) -> jax.Array:
        """The stream's key, or the key of one of several evaluations."""
        return jax.random.fold_in(jax.random.key(seed), self + number)
