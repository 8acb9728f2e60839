"""Wilson intervals."""

import pytest

from lorasp_jax.evaluation.metrics import wilson_interval


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
