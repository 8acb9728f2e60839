"""Random streams of a run: distinct, and unchanged between versions."""

import itertools

import jax
import pytest

from lorasp_jax.training.random_streams import RandomStream


def test_no_two_streams_share_a_key():
    keys = [stream.key(3) for stream in RandomStream]
    keys += [RandomStream.EVALUATION.key(3, number) for number in range(1, 8)]
    for one, other in itertools.combinations(keys, 2):
        assert one != other
    assert max(RandomStream) == RandomStream.EVALUATION  # so that sums with it are no other stream


@pytest.mark.parametrize(
    ("stream", "number", "folded"),
    [
        *(("DEMONSTRATIONS", 0, 1), ("TRAINING", 0, 2), ("ADAPTERS", 0, 3), ("BASE", 0, 4)),
        *(("STATISTICS", 0, 5), ("EVALUATION", 0, 10), ("EVALUATION", 3, 13)),
    ],
)
def test_runs_stay_reproducible(stream, number, folded):
    """The values with which the bases in assets/ were trained."""
    assert RandomStream[stream].key(7, number) == jax.random.fold_in(jax.random.key(7), folded)
