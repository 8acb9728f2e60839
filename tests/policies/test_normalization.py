"""Compare with the formulas of openpi (transforms.py) and LeRobot (normalize_processor.py)."""

import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.policies.normalization import MIN_SPREAD, normalize, unnormalize

STATS = {
    "mean": [0.5, -1.0, 2.0, 0.1],
    "std": [2.0, 0.1, 1e-5, 0.0],
    "min": [-1.0, -2.0, 1.0, 3.0],
    "max": [3.0, 0.5, 1.0, 3.00001],
    "q01": [-0.9, -1.9, 1.0, 3.0],
    "q99": [2.9, 0.4, 1.0, 3.00001],
    "q10": [-0.5, -1.2, 1.0, 3.0],
    "q90": [2.1, 0.3, 1.0, 3.00001],
}
STATS = {name: np.array(values, np.float32) for name, values in STATS.items()}
X = np.array([[0.7, -0.9, 2.0, 0.1], [-3.0, 1.0, 1.0, 3.0]], np.float32)
Y = np.array([[0.3, -1.2, 0.0, 1.0]], np.float32)
K = {name: values.astype(np.float64) for name, values in STATS.items()}
INNER = K["q90"] - K["q10"]
SPAN, RANGE = K["q99"] - K["q01"], K["max"] - K["min"]

EXPECTED = {
    ("mean_std", "openpi"): (
        (X - K["mean"]) / (K["std"] + 1e-6),
        Y * (K["std"] + 1e-6) + K["mean"],
    ),
    ("quantiles", "openpi"): (
        (X - K["q01"]) / (SPAN + 1e-6) * 2 - 1,
        (Y + 1) / 2 * (SPAN + 1e-6) + K["q01"],
    ),
    ("mean_std", "lerobot"): ((X - K["mean"]) / (K["std"] + 1e-8), Y * K["std"] + K["mean"]),
    ("min_max", "lerobot"): (
        2 * (X - K["min"]) / np.where(RANGE == 0, 1e-8, RANGE) - 1,
        (Y + 1) / 2 * np.where(RANGE == 0, 1e-8, RANGE) + K["min"],
    ),
    ("quantiles", "lerobot"): (
        2 * (X - K["q01"]) / np.where(SPAN == 0, 1e-8, SPAN) - 1,
        (Y + 1) * np.where(SPAN == 0, 1e-8, SPAN) / 2 + K["q01"],
    ),
    ("quantile10", "lerobot"): (
        2 * (X - K["q10"]) / np.where(INNER == 0, 1e-8, INNER) - 1,
        (Y + 1) * np.where(INNER == 0, 1e-8, INNER) / 2 + K["q10"],
    ),
    ("mean_std", "ours"): (
        (X - K["mean"]) / np.maximum(K["std"], MIN_SPREAD),
        Y * np.maximum(K["std"], MIN_SPREAD) + K["mean"],
    ),
    ("identity", "openpi"): (X, Y),
}


@pytest.mark.parametrize(("mode", "convention"), EXPECTED)
def test_normalize_and_unnormalize(mode, convention):
    normalized, restored = EXPECTED[mode, convention]
    actual = normalize(jnp.asarray(X), STATS, mode, convention)
    np.testing.assert_allclose(actual, normalized, rtol=1e-4, atol=1e-6)
    actual = unnormalize(jnp.asarray(Y), STATS, mode, convention)
    np.testing.assert_allclose(actual, restored, rtol=1e-5, atol=1e-6)


def test_bounds_map_to_minus_one_and_one():
    ends = np.stack([STATS["min"], STATS["max"]])[:, :2]
    stats = {name: values[:2] for name, values in STATS.items()}
    actual = normalize(jnp.asarray(ends), stats, "min_max", "lerobot")
    np.testing.assert_allclose(actual, [[-1, -1], [1, 1]], atol=1e-6)


def test_missing_statistics_are_named():
    with pytest.raises(ValueError, match=r"'quantiles' .*q01.*mean"):
        normalize(jnp.asarray(X), {"mean": STATS["mean"]}, "quantiles", "openpi")
