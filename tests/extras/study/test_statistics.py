"""Intervals contain the truth as often as stated, and pairing removes what methods share."""

import numpy as np
import pytest

from lorasp_jax.extras.study import statistics


def studies(count, *, spread, seeds=3, tasks=2, layouts=64, rate=0.8):
    """Return outcomes [count, S, T, N] of policies whose rates differ between seeds."""
    rng = np.random.default_rng(0)
    policies = rate + spread * rng.standard_normal((count, seeds, 1, 1))
    return rng.random((count, seeds, tasks, layouts)) < policies


def coverage(methods, truth):
    estimates = [statistics.success(method) for method in methods]
    return np.mean([e.low <= truth <= e.high for e in estimates])


@pytest.mark.parametrize(
    ("seeds", "spread", "low", "high"),
    [(3, 0.0, 0.97, 1.0), (3, 0.06, 0.8, 0.96), (8, 0.06, 0.88, 0.98)],
)
def test_coverage(seeds, spread, low, high):
    covered = coverage(studies(150, seeds=seeds, spread=spread), 0.8)
    assert low <= covered <= high


def test_intervals_widen_with_the_spread_between_seeds():
    narrow, wide = (studies(1, spread=spread)[0] for spread in (0.0, 0.15))
    widths = [e.high - e.low for e in map(statistics.success, (narrow, wide))]
    assert widths[1] > 1.5 * widths[0]


def test_pairing_removes_what_seeds_and_layouts_do_to_both():
    rng = np.random.default_rng(1)
    difficulty = rng.random((3, 2, 64)) + 0.1 * rng.standard_normal((3, 1, 1))
    a, b = difficulty < 0.6, difficulty < 0.5
    paired = statistics.difference(a, b)
    assert paired.value == pytest.approx(a.mean() - b.mean())
    alone = [statistics.success(method) for method in (a, b)]
    assert paired.high - paired.low < 0.6 * sum(e.high - e.low for e in alone)
    assert statistics.difference(a, a) == (0, 0, 0)


def test_a_sure_method_has_an_interval_of_no_width():
    assert statistics.success(np.ones((3, 4, 16), bool)) == (1, 1, 1)


def test_repeated_estimates_are_equal():
    (method,) = studies(1, spread=0.05)
    first = statistics.success(method)
    statistics._counts.cache_clear()
    assert statistics.success(method) == first


def test_draws_are_uniform():
    counts = statistics._counts(0, 3)
    assert (counts.sum(1) == 3).all()
    np.testing.assert_allclose(counts.mean(0), 1, atol=0.03)


def test_tasks_of_separate_cells_are_stacked_by_name():
    multi = [
        [{"outcomes": {"press": "10", "pour": "11"}}],
        [{"outcomes": {"pour": "00", "press": "01"}}],
    ]
    single = [
        [{"outcomes": {task: o}} for task, o in cell["outcomes"].items()] for (cell,) in multi
    ]
    expected = [[[1, 1], [1, 0]], [[0, 0], [0, 1]]]
    np.testing.assert_array_equal(statistics.outcomes(multi), expected)
    np.testing.assert_array_equal(statistics.outcomes(single), expected)


def test_unequal_cells_are_errors():
    with pytest.raises(ValueError, match="all seeds need the same tasks"):
        statistics.outcomes([[{"outcomes": {"press": "10"}}], [{"outcomes": {"press": "1"}}]])
    with pytest.raises(ValueError, match="methods need the same seeds"):
        statistics.difference(np.ones((3, 2, 4), bool), np.ones((2, 2, 4), bool))


def runs_of_cells(cells, *, spread, runs=3, tasks=2, layouts=100, seed=0):
    """Return the outcomes `[R, T, N]` of cells whose layouts differ in difficulty."""
    rng = np.random.default_rng(seed)
    layout = rng.uniform(0.3, 0.7, (cells, 1, tasks, layouts))
    run = spread * rng.standard_normal((cells, runs, 1, 1))
    return list(rng.random((cells, runs, tasks, layouts)) < layout + run)


@pytest.mark.parametrize("spread", [0.0, 0.03, 0.08])
def test_variance_between_runs_is_recovered(spread):
    found = statistics.between_runs(runs_of_cells(600, spread=spread))
    assert found.degrees == 1200
    assert found.deviation == pytest.approx(spread, abs=0.012 if spread == 0 else 0.004)


def test_variance_between_runs_is_unbiased_in_small_studies():
    squares = [
        statistics.between_runs(runs_of_cells(3, spread=0.08, runs=2, seed=seed)).deviation ** 2
        for seed in range(400)
    ]
    assert np.mean(squares) == pytest.approx(0.08**2, rel=0.12)


def test_widened_intervals_cover_the_rate_of_another_run():
    covered = [0, 0]
    for seed in range(300):
        cells = runs_of_cells(8, spread=0.08, runs=2, seed=seed)
        spread = statistics.between_runs(cells)
        rng = np.random.default_rng([seed, 1])
        (one,) = (rng.random((1, 2, 100)) < 0.5 + 0.08 * rng.standard_normal() for _ in range(1))
        alone = statistics.success(one)
        for i, estimate in enumerate((alone, statistics.widened(alone, spread))):
            covered[i] += estimate.low <= 0.5 <= estimate.high
    assert covered[0] < 0.75 * 300
    assert covered[1] >= 0.92 * 300


def test_intervals_widen_in_quadrature():
    estimate, spread = statistics.Estimate(0.5, 0.4, 0.55), statistics.Variation(0.1, 1)
    wide = statistics.widened(estimate, spread, 0.5)
    more = 12.7062 * 0.1 / 2**0.5
    assert wide.value - wide.low == pytest.approx((0.1**2 + more**2) ** 0.5, rel=1e-3)
    assert wide.high - wide.value == pytest.approx((0.05**2 + more**2) ** 0.5, rel=1e-3)
    assert statistics.widened(estimate, statistics.Variation(0.0, 3)) == pytest.approx(estimate)
