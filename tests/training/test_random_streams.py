"""Random streams of a run: distinct, and unchanged between versions."""

import itertools

import jax
import numpy as np
import pytest

from lorasp_jax.training.random_streams import RandomStream

TASKS = ("open_pot", "pour", "press", "pick_place")


def test_no_two_streams_share_a_key():
    keys = [stream.key(3) for stream in RandomStream]
    evaluations = (RandomStream.EVALUATION, RandomStream.FINAL_EVALUATION)
    keys += [stream.key(3, task) for stream in evaluations for task in TASKS]
    for one, other in itertools.combinations(keys, 2):
        assert one != other


@pytest.mark.parametrize(
    ("stream", "folded"),
    [
        *(("DEMONSTRATIONS", 1), ("TRAINING", 2), ("ADAPTERS", 3), ("BASE", 4)),
        *(("STATISTICS", 5), ("EVALUATION", 10), ("FINAL_EVALUATION", 11)),
    ],
)
def test_runs_stay_reproducible(stream, folded):
    """The values with which the bases in assets/ were trained."""
    assert RandomStream[stream].key(7) == jax.random.fold_in(jax.random.key(7), folded)


def test_a_task_has_the_same_layouts_in_every_process():
    expected = jax.random.fold_in(RandomStream.EVALUATION.key(7), np.uint32(0x7DC47CBD))
    assert RandomStream.EVALUATION.key(7, "press") == expected
