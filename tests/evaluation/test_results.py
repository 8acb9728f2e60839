"""Results of several batches of episodes."""

import jax.numpy as jnp
import numpy as np
import pytest

from envs.state import Poses
from lorasp_jax.evaluation.programs import Rollout
from lorasp_jax.evaluation.results import _result


def batch(success, steps, counts, randomized=None):
    """A rollout with poses world + time / 100."""
    pose = np.arange(9)[:, None] / 100 + np.arange(len(success))
    return Rollout(
        success=jnp.array(success),
        steps=jnp.array(steps),
        running=jnp.array([3, 1]),
        active_rank={"vision": {"fc1": jnp.array([[1.0, 3.0], [5.0, 3.0]])}},
        active_rank_histogram={"vision": jnp.array(counts, jnp.int32)},
        poses=Poses(*(pose,) * 4),
        draw=randomized and jnp.arange(len(success)),
    )


def test_batches_are_aggregated():
    max_int32 = 2**31 - 1
    first = batch([False, True, True], [9, 4, 6], [[0, max_int32], [1, max_int32]])
    second = batch([False, False, False], [9, 9, 9], [[0, 5], [2, 0]])
    result = _result([first, second])
    assert (result.success, result.episodes) == (pytest.approx(1 / 3), 6)
    assert result.outcomes == (False, True, True, False, False, False)
    assert result.steps == pytest.approx(46 / 6)
    assert result.active_rank == {"vision": {"fc1": [2.0, 3.0]}}  # weighted by running worlds
    assert result.active_rank_histogram["vision"].tolist() == [3, 2 * max_int32 + 5]
    np.testing.assert_allclose(result.poses[0], [1.0, 1.01, 1.02, 1.03])  # up to its end
    assert "poses" not in repr(result)
    assert result.draw is None
    np.testing.assert_allclose(_result([second]).poses[0], np.arange(9) / 100)


def test_randomized_values_are_those_of_the_recorded_episode():
    counts = [[0, 1], [0, 1]]
    for success, world in (([False, False, True], 2), ([False, False, False], 0)):
        assert _result([batch(success, [9, 9, 9], counts, randomized=True)]).draw == world
