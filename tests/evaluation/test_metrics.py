"""Wilson intervals; the tokens over which active ranks are averaged."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.base.intervals import wilson_interval
from lorasp_jax.evaluation import metrics
from lorasp_jax.evaluation.metrics import position_bias
from lorasp_jax.peft import Aux

layer_ranks = jax.jit(metrics.layer_ranks)
rank_histogram = jax.jit(metrics.rank_histogram, static_argnums=2)
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


def outcomes(rng, *, wrong_rows=False):
    """Two tasks of 256 episodes; with wrong rows, success is rarer in odd ones."""
    rates = np.where(wrong_rows & (np.arange(256) % 2 == 1), 0.2, 0.9)
    return [rng.random(256) < rates, rng.random(256) < rates / 3]


def test_success_that_depends_on_the_position_is_found():
    rng = np.random.default_rng(0)
    assert not any(position_bias(outcomes(rng)) for _ in range(200))
    for _ in range(20):
        assert "bit 0" in position_bias(outcomes(rng, wrong_rows=True))


@pytest.mark.parametrize("success", [[], [True], [False] * 9, [True, False] * 16])
def test_few_or_equal_outcomes_show_no_position_bias(success):
    assert not position_bias([success])


def reports(rank):
    """Two layers, three worlds, four tokens; the last two tokens of world 1 are padding."""
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


def test_ranks_ignore_padding_and_finished_worlds():
    ranks = layer_ranks(reports(jnp.arange(24.0).reshape(2, 3, 4)), RUNNING)
    np.testing.assert_allclose(ranks["vision"]["fc1"], [4.5, 16.5])
    np.testing.assert_allclose(ranks["action"]["fc1"], [9.5, 21.5])
    assert "none" not in ranks["action"]
    assert not ranks["language"]


def test_histogram_counts_the_same_tokens():
    histogram = rank_histogram(reports(jnp.arange(24.0).reshape(2, 3, 4)), RUNNING, 30)
    assert set(histogram) == {"vision", "action"}
    for tower, expected in (("vision", [4, 5, 16, 17]), ("action", [4, 5, 14, 15, 16, 17, 26, 27])):
        assert histogram[tower].shape == (31,)
        assert np.flatnonzero(histogram[tower]).tolist() == expected
        assert histogram[tower].sum() == len(expected)


def test_histogram_of_several_images_per_world():
    """Two images per world are folded into W, and the counts of linear layers are added."""
    rank = jnp.array([[1.0, 2.0], [2.0, 2.0], [3.0, 3.0], [3.0, 3.0]])
    mask = jnp.array([[True, True], [True, False], [True, True], [True, True]])
    aux = {"vision": {name: Aux(rank, token_mask=mask) for name in ("fc1", "fc2")}}
    histogram = rank_histogram(aux, jnp.array([True, False]), 3)
    assert histogram["vision"].tolist() == [0, 2, 4, 0]
    assert rank_histogram(aux, jnp.array([False, False]), 3)["vision"].tolist() == [0] * 4
    assert rank_histogram({"vision": {"fc1": Aux()}}, jnp.array([True]), 0) == {}
