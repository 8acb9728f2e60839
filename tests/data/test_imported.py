"""Datasets of a run: incompatible ones are refused early."""

import dataclasses

import numpy as np
import pytest

from envs.datasets import rlds
from lorasp_jax.config import DataConfig
from lorasp_jax.data import cache
from lorasp_jax.data.cache import Cache
from lorasp_jax.data.opening import open_source
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.training import dataset
from tests.data.lerobots import golden
from tests.runs import CONFIG, random_episodes

MODEL = dataclasses.replace(Pi0Config.dummy(), max_tokens=12)


def config(source, **changes):
    return dataclasses.replace(CONFIG, data=DataConfig(source=str(source)), **changes)


def quietly(done, total):
    pass


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """A cache of two tasks."""
    folder = tmp_path_factory.mktemp("simulated")
    for number, task in enumerate(("press", "pour")):
        rlds.write(random_episodes(task, number), folder / task)
    sources = [open_source(folder / task) for task in ("press", "pour")]
    cache.write(sources, folder / "cache", quietly)
    return Cache(folder / "cache")


def test_a_dataset_becomes_a_cache_once(tmp_path):
    chosen = config(golden("v3"))
    source = dataset.open_dataset(chosen, MODEL, tmp_path)
    found = dataset.as_cache(source, tmp_path, quietly)
    size = MODEL.image_size  # longer image side of the model input
    assert found.cameras["side"] == [size * 96 // 128, size]
    again = dataset.open_dataset(chosen, MODEL, tmp_path)
    assert isinstance(again, Cache)
    assert again.path == found.path == tmp_path / "cache" / "steps"
    assert dataset.as_cache(again, tmp_path, quietly) is again
    assert not simulates(found.metadata)


@pytest.mark.parametrize(
    ("changes", "model", "sentence"),
    [
        (
            {"control_dt": 0.05},
            {},
            r"period of 0\.1 s, but this run has --control-dt 0\.05: pass --control-dt 0\.1, or",
        ),
        ({}, {"cameras": ("side",)}, "has cameras side, wrist, but the backbone accepts at most 1"),
    ],
)
def test_incompatible_datasets_are_refused_early(changes, model, sentence, tmp_path):
    with pytest.raises(ValueError, match=sentence):
        dataset.open_dataset(
            config(golden("v3"), **changes),
            dataclasses.replace(MODEL, **model),
            tmp_path,
        )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"actions": "delta_joint"}, "has delta_joint actions, but policies learn joint"),
        (
            dict.fromkeys(("state", "action"), np.zeros((3, 9, 14), np.float32)),
            "1 to 7 for this backbone, got 13; select entries with .* --state-numbers",
        ),
    ],
)
def test_unsupported_dimensions_are_refused(changes, sentence, tmp_path):
    path = tmp_path / "recorded"
    rlds.write(dataclasses.replace(random_episodes("press", 0), **changes), path)
    with pytest.raises(ValueError, match=sentence):
        dataset.open_dataset(config(path), MODEL, tmp_path / "run")


def test_outline(simulated):
    """States and actions are those of the episodes; images are only outlined."""
    found = dataset.outline(simulated)
    assert list(found) == ["press", "pour"]
    for number, (task, group) in enumerate(found.items()):
        wanted = random_episodes(task, number)
        group.validate()
        np.testing.assert_array_equal(group.length, wanted.length)
        for episode, length in enumerate(wanted.length):
            for name in ("state", "action"):
                rows = getattr(group, name)[episode]
                expected = getattr(wanted, name)[episode, :length]
                np.testing.assert_array_equal(rows[:length], expected)
                assert not rows[length:].any()
            assert group.phrases[episode] == wanted.phrases[episode]
        first = wanted.image["wrist"][0, 0]
        assert (group.image["wrist"] == first).all()
        assert group.image["wrist"].base is not None  # takes no memory


def simulates(facts):
    return dataset.is_simulated(*(facts[name] for name in ("tasks", "robot", "physics_dt")))


def test_which_datasets_can_be_simulated(simulated):
    assert simulates(simulated.metadata)
    # The last: recordings of a real robot.
    for changed in ({"robot": "so101"}, {"tasks": ["press", "fold"]}, {"physics_dt": 0.0}):
        assert not simulates(simulated.metadata | changed)
