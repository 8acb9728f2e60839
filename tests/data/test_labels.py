"""Labels of episodes: outcomes and a person's corrections, in every format."""

import dataclasses
import json
import shutil

import numpy as np
import pyarrow as pa
import pytest
from rich.console import Console

from envs.datasets import rlds
from envs.datasets.episodes import Episodes, concatenate
from lorasp_jax.base.digest import verify_digest, with_digest
from lorasp_jax.data import cache, inspection, lerobot_export, lerobot_features
from lorasp_jax.data.keys import Keys
from lorasp_jax.data.lerobot import LeRobot
from lorasp_jax.data.opening import open_source, open_sources
from tests.data.lerobots import edit_rows
from tests.runs import random_episodes

OUTCOMES = [1, 0, -1]


def quietly(*_):
    """Report no progress."""


def labelled(seed=0, outcomes=OUTCOMES):
    """Three episodes of 5, 9 and 7 steps; a person takes over in the last steps of the second."""
    corrected = np.zeros((3, 9), bool)
    corrected[1, 6:] = True
    labels = {"success": np.array(outcomes, np.int32), "corrected": corrected}
    return dataclasses.replace(random_episodes("press", seed), physics_dt=0.0, **labels)


def labels_of(source):
    """Return outcomes, and the episodes and steps with corrections."""
    episodes = [source.episode(number, ()) for number in range(len(source))]
    marked = [(n, int(t)) for n, e in enumerate(episodes) for t in np.flatnonzero(e.corrected)]
    return [int(e.success[0]) for e in episodes], marked


CORRECTED = [(1, 6), (1, 7), (1, 8)]


@pytest.fixture(scope="module")
def formats(tmp_path_factory):
    """The same episodes in all formats, each converted from the one before."""
    folder = tmp_path_factory.mktemp("labels")
    rlds.write(labelled(), folder / "rlds")
    lerobot_export.to_lerobot(open_source(folder / "rlds"), folder / "lerobot", quietly)
    cache.write([open_source(folder / "lerobot")], folder / "cache", quietly)
    return folder


@pytest.mark.parametrize("name", ["rlds", "lerobot", "cache"])
def test_every_format_keeps_labels(formats, name):
    assert labels_of(open_source(formats / name)) == (OUTCOMES, CORRECTED)


def test_lerobots_names_are_used(formats):
    features = LeRobot(formats / "lerobot").index.features
    for name in ("next.success", "next.done", "intervention"):
        assert features[name]["dtype"] == "bool"
    every = LeRobot(formats / "lerobot", Keys(every=3))
    assert labels_of(every) == (OUTCOMES, [(1, 2)])  # step 6


def test_inspect_counts_them(formats, capsys):
    inspection.report(open_source(formats / "rlds"), Console(width=200))
    printed = capsys.readouterr().out
    assert "outcomes 1 successes, 1 failures, 1 without a label" in printed
    assert "takeover a person acts in 3 steps" in printed


def test_an_episode_file_keeps_them(tmp_path):
    labelled().save(tmp_path / "press.npz")
    found = Episodes.load(tmp_path / "press.npz")
    assert found.success.tolist() == OUTCOMES
    assert found.corrected.sum() == 3


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"success": np.array([1, 0, 2], np.int32)}, "success must be int32"),
        ({"success": np.ones(2, np.int32)}, r"success must be int32 \(3,\)"),
        ({"corrected": np.zeros((3, 9), np.int32)}, r"corrected must be bool_? \(3, 9\)"),
    ],
)
def test_labels_that_make_no_sense(changes, sentence):
    with pytest.raises(ValueError, match=sentence):
        dataclasses.replace(labelled(), **changes).validate()


def test_episodes_without_labels_join_those_with(formats, tmp_path):
    both = concatenate([random_episodes("press", 1), random_episodes("press", 2)])
    assert both.success is both.corrected is None
    mixed = concatenate(
        [dataclasses.replace(random_episodes("press", 1), physics_dt=0.0), labelled()]
    )
    assert mixed.success.tolist() == [-1, -1, -1, *OUTCOMES]
    plain = dataclasses.replace(random_episodes("press", 1), physics_dt=0.0)
    rlds.write(plain, tmp_path / "plain")  # successes, as the format has it
    joined = open_sources([tmp_path / "plain", formats / "cache"], Keys())
    cache.write([joined], tmp_path / "joined", quietly)
    found = cache.Cache(tmp_path / "joined")
    assert found.success.tolist() == [1, 1, 1, *OUTCOMES]
    assert np.flatnonzero(found.corrected).tolist() == [21 + 5 + step for step in (6, 7, 8)]


def test_a_cache_from_before_there_were_labels_is_read(formats, tmp_path):
    shutil.copytree(formats / "cache", tmp_path / "old")
    header = tmp_path / "old" / cache.HEADER
    content = verify_digest(json.loads(header.read_text()))
    for name in cache.LABELS:
        del content["crc32"][name]
        (tmp_path / "old" / f"{name}.npy").unlink()
    header.write_text(json.dumps(with_digest(content)))
    found = cache.Cache(tmp_path / "old")
    assert found.success is found.corrected is found.episode(0, ()).success is None


def test_a_dataset_marks_corrections_from_its_first_episode_on(tmp_path):
    writer = rlds.ShardWriter(tmp_path / "data", {})
    writer.append(dataclasses.replace(labelled(), corrected=None))
    with pytest.raises(ValueError, match="cannot mark corrections: choose another folder"):
        writer.append(labelled())
    other = rlds.ShardWriter(tmp_path / "other", {})
    other.append(labelled())
    other.append(dataclasses.replace(labelled(), corrected=None))
    other.complete()
    assert labels_of(open_source(tmp_path / "other")) == (2 * OUTCOMES, CORRECTED)


def test_a_correction_belongs_to_the_action_of_its_step(formats):
    every = LeRobot(formats / "lerobot", Keys(every=4))  # with actions of frames 3, 7 and 8
    assert labels_of(every)[1] == [(1, 1), (1, 2)]


def edited(formats, folder, **columns):
    """Copy the LeRobot dataset; give every frame of its first episode these values, or none."""
    shutil.copytree(formats / "lerobot", folder)

    def change(table):
        for name, value in columns.items():
            dotted = name.replace("__", ".")
            table = table.drop_columns([dotted]) if dotted in table.column_names else table
            if value is not None:
                table = table.append_column(dotted, pa.array(len(table) * value))
        return table

    edit_rows(folder, change)
    return LeRobot(folder)


@pytest.mark.parametrize(
    ("success", "outcome"),
    [([None], -1), ([float("nan")], -1), ([-1], -1), ([0], 0), ([False], 0), ([1], 1)],
)
@pytest.mark.parametrize("done", [[True], None])
def test_an_outcome_that_nobody_gave_is_unknown(success, outcome, done, formats, tmp_path):
    values = pa.array(success).cast(pa.float64()).to_pylist()
    found = edited(formats, tmp_path / "data", next__success=values, next__done=done)
    assert found.episode(0, ()).success.tolist() == [outcome]
    assert found.episode(1, ()).success.tolist() == [0]


def test_a_mark_is_one_number_of_a_frame(formats, tmp_path):
    """Features with the names of marks that are something else, or missing, are ignored."""
    others = {
        "is_intervention": {"dtype": "bool", "shape": [2]},
        "annotation.intervention": {"dtype": "string", "shape": [1]},
        "observation.images.intervention": {"dtype": "video", "shape": [8, 8, 3]},
        "next.success": {"dtype": "string", "shape": [1]},
    }
    assert lerobot_features.marks(others) == []
    assert lerobot_features.marks({"is_intervention": {"dtype": "float32"}}) == ["is_intervention"]
    found = edited(formats, tmp_path / "data", next__success=None, intervention=None)
    assert found.episode(0, ()).labels == {}
    assert found.episode(1, ()).labels.keys() == {"success", "corrected"}


def test_unlabelled_episodes_are_exported_with_labelled_ones(formats, tmp_path):
    plain = edited(formats, tmp_path / "plain", next__success=None, intervention=None)
    lerobot_export.to_lerobot(plain, tmp_path / "out", quietly)
    assert labels_of(LeRobot(tmp_path / "out")) == ([-1, 0, -1], CORRECTED)


def test_a_cache_tells_unlabelled_from_unknown(formats, tmp_path):
    plain = edited(formats, tmp_path / "plain", next__success=None, intervention=None)
    cache.write([plain], tmp_path / "cache", quietly)
    found = cache.Cache(tmp_path / "cache")
    assert found.success.tolist() == [cache.UNLABELLED, 0, -1]
    assert found.episode(0, ()).success is None
    assert found.episode(2, ()).success.tolist() == [-1]
