"""Intervals of biased statistics contain the truth, and those of means stay as they are."""

import numpy as np
import pytest

from lorasp_jax.extras.study import statistics
from studies.paper import estimates


def test_a_corrected_standard_deviation_covers_the_true_one():
    """Tasks at 80, 90, 90 and 100 %, three seeds that do not differ."""
    rng = np.random.default_rng(0)
    rates = np.array([0.8, 0.9, 0.9, 1.0])
    spread = lambda rates: rates.std(-1)  # noqa: E731
    methods = rng.random((60, 3, 4, 256)) < rates[:, None]
    found = [estimates.corrected(spread, method) for method in methods]
    truth = rates.std()
    assert sum(e.low <= truth <= e.high for e in found) >= 54
    assert np.mean([e.value for e in found]) == pytest.approx(truth, abs=0.002)
    assert all(e.low < e.value < e.high for e in found)


def test_a_correction_leaves_means_as_they_are():
    method = np.random.default_rng(0).random((3, 2, 64)) < 0.8
    plain, mended = (
        f(statistics.mean, method) for f in (statistics.bootstrap, estimates.corrected)
    )
    assert mended.value == pytest.approx(plain.value, abs=1e-3)
    assert mended.high - mended.low == pytest.approx(plain.high - plain.low)


def test_student_interval():
    estimate = estimates.over_seeds([1.0, 2.0, 3.0])
    assert estimate == pytest.approx((2, 2 - 4.303 / 3**0.5, 2 + 4.303 / 3**0.5))
