"""An RLDS dataset runs no code, stays in its folder, and takes bounded memory."""

import dataclasses
import io
import json
import os
import sys

import numpy as np
import pytest
from array_record.python import array_record_module
from PIL import Image
from tensorflow_datasets.proto import tf_example_pb2

from envs.datasets import rlds, rlds_schema
from tests.envs.datasets.test_episodes import assert_equal, make
from tests.envs.datasets.test_rlds import trimmed

EVIL = "evil_of_a_dataset.Evil"


@pytest.fixture
def path(tmp_path, monkeypatch):
    """A dataset in a folder from which Python imports modules, like the working folder."""
    rlds.write(make(), tmp_path / "press")
    (tmp_path / "press" / "evil_of_a_dataset.py").write_text("open('harm', 'w')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path / "press")
    yield tmp_path / "press"
    assert "evil_of_a_dataset" not in sys.modules
    assert not (tmp_path / "harm").exists()


def edit(file, change):
    found = json.loads(file.read_text())
    change(found)
    file.write_text(json.dumps(found))


@pytest.mark.parametrize("name", ["features.json", "dataset_info.json"])
def test_descriptions_of_classes_are_not_read(name, path):
    """tfds would import the class."""
    (path / name).write_text(json.dumps({"pythonClassName": EVIL}))
    assert_equal(rlds.read(path), trimmed(make()))


def test_more_episodes_than_records(path):
    edit(path / "metadata.json", lambda found: found.update(parts=[10**12]))
    with pytest.raises(ValueError, match="expected 1000000000000"):
        rlds.Reader(path)


@pytest.mark.parametrize(
    "name", ["metadata.json", "dataset_info.json", "press_piper-train.array_record-00000"]
)
def test_links_and_pipes(name, path, tmp_path):
    (path / name).rename(tmp_path / "outside")
    (path / name).symlink_to(tmp_path / "outside")
    with pytest.raises(ValueError, match=f"{name} .*outside of"):
        rlds.Reader(path)
    (path / name).unlink()
    os.mkfifo(path / name)
    with pytest.raises(ValueError, match=name):
        rlds.Reader(path)


def test_images_of_another_size(path):
    """They are refused before they are decoded."""
    edit(path / "metadata.json", lambda found: found["cameras"].update(side=[60, 80]))
    with pytest.raises(ValueError, match="6 x 8"):
        rlds.read(path)


def test_images_without_colors(path, monkeypatch):
    """A 16-bit PNG is depth."""
    file = io.BytesIO()
    Image.fromarray(np.full((6, 8), 900, np.uint16)).save(file, "png")
    monkeypatch.setattr(rlds_schema, "_encode", lambda images: [file.getvalue()] * len(images))
    rlds.write(make(), path.parent / "depth")
    with pytest.raises(ValueError, match="mode I;16, not RGB"):
        rlds.read(path.parent / "depth")


def test_lengths_of_states_and_actions(path):
    edit(path / "metadata.json", lambda found: found.update(widths=[7, 6]))
    with pytest.raises(ValueError, match=r"press: episode 0 is damaged .action has .* not 6 each"):
        rlds.read(path)
    edit(path / "metadata.json", lambda found: found.pop("widths"))  # older datasets
    assert rlds.read(path).action.shape[2] == 7


@pytest.mark.parametrize("names", [["gripper"], ["a", 1], "abcdefg", {}])
def test_names_of_dimensions(names, path):
    edit(path / "metadata.json", lambda found: found["options"].update(names=names))
    with pytest.raises(ValueError, match=r"options\.names"):
        rlds.Reader(path)


def test_dimensions_are_known_by_their_names(path):
    names = ["left_gripper", *"abcd", "right_gripper", "e"]
    edit(path / "metadata.json", lambda found: found["options"].update(names=names))
    source = rlds.Reader(path)
    assert source.names == {"state": names, "action": names}
    assert source.grippers == {"state": [0, 5], "action": [0, 5]}


@pytest.mark.parametrize("number", [-1, 5, 2**40])
def test_instructions_that_do_not_exist(number, path):
    (file,) = path.glob("*array_record*")
    (record, *_) = array_record_module.ArrayRecordReader(str(file)).read_all()
    example = tf_example_pb2.Example.FromString(record)
    fields = example.features.feature
    fields["episode_metadata/instruction"].int64_list.value[:] = [number]
    shared = {"instructions": ("a",), "task": "x", "robot": "y", "control_dt": 0.1, "physics_dt": 0}
    with pytest.raises((ValueError, OverflowError)):
        rlds_schema.episode(
            example.SerializeToString(), {}, {}, (0, 0), shared | {"attempted": 1}
        ).validate_numbers()


def test_hidden_copies_of_macos(path):
    (file,) = path.glob("*array_record*")
    file.with_name(f"._{file.name}").write_bytes(b"\0\5\26\7")
    assert rlds.read(path).num_episodes == make().num_episodes


@pytest.mark.parametrize("name", ["../../harm", "/tmp/harm", "é" * 300, ""])
def test_names_of_tasks_and_robots_are_not_paths(name, path, tmp_path):
    before = sorted(tmp_path.iterdir())
    rlds.write(make(task=name, robot=name), tmp_path / "other")
    assert sorted(tmp_path.iterdir()) == sorted([*before, tmp_path / "other"])
    assert len(list((tmp_path / "other").iterdir())) == 4
    assert rlds.read(tmp_path / "other").task == name


@pytest.mark.parametrize("name", ["../x", "a/b", "", "x" * 101])
def test_names_of_cameras_are_not_paths(name, tmp_path):
    episodes = make()
    images = {name: episodes.image["side"]}
    with pytest.raises(ValueError, match="camera"):
        rlds.write(dataclasses.replace(episodes, image=images), tmp_path / "other")
    assert not list(tmp_path.iterdir())


def rewrite(path, episodes):
    """Replace a dataset's records by ones that `rlds.write` would refuse."""
    to = rlds_schema.serializer(rlds_schema.features(rlds.metadata(path)))
    (file,) = path.glob("*array_record*")
    writer = array_record_module.ArrayRecordWriter(str(file), "group_size:1,uncompressed")
    for number in range(episodes.num_episodes):
        writer.write(rlds_schema.record(to, episodes, number, number))
    writer.close()


def test_values_that_are_not_finite(path):
    episodes = make()
    episodes.state[1, 0, 2] = np.nan
    rewrite(path, episodes)
    with pytest.raises(ValueError, match=r"press: episode 1 is damaged .*state .* dimension 2"):
        rlds.read(path)


def test_an_empty_episode(path):
    one = make()
    nothing = {name: picture[:, :0] for name, picture in one.image.items()}
    rewrite(path, dataclasses.replace(one, image=nothing, length=np.array([1, 0, 1], np.int32)))
    with pytest.raises(ValueError, match="press: episode 0 is damaged"):
        rlds.read(path)
