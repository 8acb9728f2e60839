"""Random streams of a run: distinct, and unchanged between versions."""

import itertools

import jax
import numpy as np

from lorasp_jax.training.random_streams import RandomStream

TASKS = ("open_pot", "pour", "press", "pick_place")


def test_no_two_streams_share_a_key():
    keys = [stream.key(3) for stream in RandomStream]
    evaluations = (RandomStream.EVALUATION, RandomStream.FINAL_EVALUATION)
    keys += [stream.key(3, task) for stream in evaluations for task in TASKS]
    for one, other in itertools.combinations(keys, 2):
        assert one != other


def test_runs_stay_reproducible():
    """The values with which the bases in assets/ were trained."""
    names = "DEMONSTRATIONS", "TRAINING", "ADAPTERS", "BASE", "STATISTICS", "EVALUATION"
    for name, folded in zip((*names, "FINAL_EVALUATION"), (1, 2, 3, 4, 5, 10, 11), strict=True):
        assert RandomStream[name].key(7) == jax.random.fold_in(jax.random.key(7), folded)


def test_a_task_has_the_same_layouts_in_every_process():
    expected = jax.random.fold_in(RandomStream.EVALUATION.key(7), np.uint32(0x7DC47CBD))
    assert RandomStream.EVALUATION.key(7, "press") == expected
