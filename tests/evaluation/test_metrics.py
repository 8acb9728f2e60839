"""Wilson intervals; which tokens active ranks are taken over."""

import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.evaluation.metrics import layer_ranks, rank_histogram, wilson_interval
from lorasp_jax.peft import Aux

RUNNING = jnp.array([False, True, False])


def test_known_values():
    # Newcombe 1998, Stat. Med. 17, 857-872, table I: 81 of 263 and 0 of 20.
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson_interval(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)


def test_bounds_and_symmetry():
    low, high = wilson_interval(64, 64)
    assert high == 1.0
    assert 0.9 < low < 1.0
    mirrored = wilson_interval(13, 64), wilson_interval(51, 64)
    assert mirrored[0][0] == pytest.approx(1 - mirrored[1][1])


@pytest.mark.parametrize(("successes", "trials"), [(0, 0), (3, 2), (-1, 4)])
def test_impossible_counts(successes: int, trials: int):
    with pytest.raises(ValueError, match="not a success rate"):
        wilson_interval(successes, trials)


def reports(rank):
    """Two layers, three worlds, four tokens, the last two of which are padding in world 1."""
    mask = jnp.ones((2, 3, 4), bool).at[:, 1, 2:].set(False)
    return {
        "vision": {"fc1": Aux(rank, token_mask=mask)},
        # [denoising steps, L, W, T]
        "action": {
            "fc1": Aux(jnp.stack([rank, rank + 10]), token_mask=jnp.stack([mask, mask])),
            "none": Aux(),
        },
        "language": {"none": Aux()},
    }


def test_ranks_leave_out_padding_and_finished_worlds():
    found = layer_ranks(reports(jnp.arange(24.0).reshape(2, 3, 4)), RUNNING)
    np.testing.assert_allclose(found["vision"]["fc1"], [4.5, 16.5])
    np.testing.assert_allclose(found["action"]["fc1"], [9.5, 21.5])
    assert "none" not in found["action"]
    assert not found["language"]


def test_histogram_counts_the_same_tokens():
    found = rank_histogram(reports(jnp.arange(24.0).reshape(2, 3, 4)), RUNNING, 30)
    assert set(found) == {"vision", "action"}
    for tower, expected in (("vision", [4, 5, 16, 17]), ("action", [4, 5, 14, 15, 16, 17, 26, 27])):
        assert found[tower].shape == (31,)
        assert np.flatnonzero(found[tower]).tolist() == expected
        assert found[tower].sum() == len(expected)


def test_histogram_of_several_pictures_a_world():
    """Pictures are folded into the worlds: [W 2 pictures, T]; their linear maps add up."""
    rank = jnp.array([[1.0, 2.0], [2.0, 2.0], [3.0, 3.0], [3.0, 3.0]])
    mask = jnp.array([[True, True], [True, False], [True, True], [True, True]])
    aux = {"vision": {name: Aux(rank, token_mask=mask) for name in ("fc1", "fc2")}}
    found = rank_histogram(aux, jnp.array([True, False]), 3)
    assert found["vision"].tolist() == [0, 2, 4, 0]
    assert rank_histogram(aux, jnp.array([False, False]), 3)["vision"].tolist() == [0] * 4
    assert rank_histogram({"vision": {"fc1": Aux()}}, jnp.array([True]), 0) == {}
