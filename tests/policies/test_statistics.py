"""Measuring, moving and serializing statistics."""

import json

import jax
import numpy as np
import pytest

from lorasp_jax.policies.normalization import MIN_SPREAD
from lorasp_jax.policies.statistics import NAMES, Statistics

DIM = 8
RNG = np.random.default_rng(0)
PIPER, PANDA = (0, 1, 2, 3, 4, 5, 7), (0, 1, 2, 3, 4, 5, 6, 7)


@pytest.mark.parametrize("slots", [PIPER, PANDA])
def test_measure_ignores_padding(slots):
    state = RNG.normal(size=(3, 6, len(slots))).astype(np.float32)
    valid = np.arange(6) < np.array([[2], [6], [4]])
    state[..., -1] = 0.07  # a gripper that never moves
    padded = np.where(valid[..., None], state, 1e6)
    measured = Statistics.measure(padded, 2 * padded, valid, slots=slots, dim=DIM)
    rows, used = state[valid], np.array(slots)
    expected = {
        "mean": rows.mean(0),
        "std": np.maximum(rows.std(0), MIN_SPREAD),
        "min": rows.min(0),
        "max": rows.max(0),
        "q01": np.percentile(rows, 1, axis=0),
        "q99": np.percentile(rows, 99, axis=0),
        "q10": np.percentile(rows, 10, axis=0),
        "q90": np.percentile(rows, 90, axis=0),
    }
    assert measured.state.keys() == set(NAMES)
    for name, values in expected.items():
        np.testing.assert_allclose(measured.state[name][used], values, 1e-5, 1e-6, err_msg=name)
    np.testing.assert_allclose(measured.action["max"][used], 2 * expected["max"], 1e-5)
    unused = np.setdiff1d(np.arange(DIM), slots)
    assert (measured.state["std"][unused] == 1).all()
    assert (measured.state["q01"][unused] == -1).all()
    with pytest.raises(ValueError, match="slots"):
        Statistics.measure(state, state, valid, slots=slots[:-1], dim=DIM)


def test_json_is_exact():
    values = RNG.normal(size=(20, 7)).astype(np.float32)
    measured = Statistics.measure(values, values**2, np.ones(20, bool), slots=PIPER, dim=DIM)
    jax.tree.map(np.testing.assert_array_equal, Statistics.from_json(measured.to_json()), measured)


def test_json_may_have_only_moments():
    content = {
        f"{k}_{n}": [float(i)] * 8 for i, k in enumerate(("state", "action")) for n in NAMES[:2]
    }
    statistics = Statistics.from_json(json.dumps(content))
    assert statistics.state.keys() == {"mean", "std"}
    assert statistics.action["std"].tolist() == [1.0] * 8


@pytest.mark.parametrize(
    "change",
    [{"state_std": [1.0]}, {"action_mean": "x"}, {"more": 1}, {"state_q50": [0.0, 0.0]}, None],
)
def test_invalid_json_raises(change):
    content = {f"{k}_{n}": [0.0, 1.0] for k in ("state", "action") for n in NAMES[:2]}
    with pytest.raises(ValueError, match="statistics"):
        Statistics.from_json(json.dumps({**content, **change} if change else {}))


def test_to_slots_reorders_and_drops_padding():
    values = np.arange(18, dtype=np.float32).reshape(2, 9)
    long = Statistics.measure(values, values, np.ones(2, bool), slots=range(9), dim=9)
    statistics = long.to_slots(PIPER, DIM)
    assert statistics.state["min"].tolist() == [0, 1, 2, 3, 4, 5, -1, 6]
    assert statistics.state["mean"].tolist() == [4.5, 5.5, 6.5, 7.5, 8.5, 9.5, 0, 10.5]
    with pytest.raises(ValueError, match="10 dimensions, got 9"):
        long.to_slots(range(10), 32)
