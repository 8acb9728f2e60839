"""Held-out episodes: the same for all runs, and nobody's training data."""

import dataclasses

import pytest

from lorasp_jax.config import DataConfig
from lorasp_jax.extras.study import held_out
from tests.runs import CONFIG


def test_held_out_episodes_depend_neither_on_the_seed_nor_on_the_training_data():
    data = dataclasses.replace(CONFIG.data, episodes=7, fresh_every=CONFIG.log_every)
    other = dataclasses.replace(CONFIG, seed=5, data=data)
    assert held_out.settings(other) == held_out.settings(CONFIG)
    data = DataConfig(source="x", validation=("0.1",), cameras=("a",), episodes=7)
    recorded = dataclasses.replace(CONFIG, data=data)
    assert held_out.settings(recorded) == held_out.settings(CONFIG)


def test_the_seed_is_reserved():
    with pytest.raises(ValueError, match="reserved for held-out episodes"):
        held_out.settings(dataclasses.replace(CONFIG, seed=held_out.SEED))
