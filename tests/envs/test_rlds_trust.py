"""An RLDS dataset runs no code, stays in its folder, and takes bounded memory."""

import dataclasses
import json
import os
import shutil
import sys

import pytest

from envs.datasets import rlds
from tests.envs.datasets.test_episodes import make

EVIL = "evil_of_a_dataset.Evil"
DICT = "tensorflow_datasets.core.features.features_dict.FeaturesDict"


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
    file.write_text(json.dumps(change(found) or found))


def inner(found):
    return found["featuresDict"]["features"]["episode_metadata"]["featuresDict"]["features"]


def legacy(kind):
    return {"type": kind, "content": {}}


FORMS = {
    "outermost": lambda found: found.update(pythonClassName=EVIL),
    "inside": lambda found: inner(found)["task"].update(pythonClassName=EVIL),
    "another spelling": lambda found: inner(found).update(
        task={"python_class_name": EVIL, "text": {}}
    ),
    "as before tfds 4.5": lambda found: {"type": DICT, "content": {"a": legacy(EVIL)}},
    "as text": lambda found: inner(found).update(
        x={"python_class_name": DICT, "json_feature": {"json": json.dumps({"a": legacy(EVIL)})}}
    ),
    "another one of tfds": lambda found: inner(found)["task"].update(
        pythonClassName="tensorflow_datasets.core.features.audio_feature.Audio"
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_no_module_is_imported(form, path):
    edit(path / "features.json", FORMS[form])
    with pytest.raises(ValueError, match="press"):
        rlds.read(path)
    with pytest.raises(ValueError, match="press"):
        rlds.ShardWriter(path, {}).complete()


@pytest.mark.parametrize(
    ("where", "value"),
    [
        ("filepathTemplate", "../{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_INDEX}"),
        ("filepathTemplate", "{DATASET.__class__}"),
        ("shardLengths", ["999999999999"]),
        ("name", "test"),
    ],
)
def test_names_and_numbers_of_files(where, value, path):
    edit(path / "dataset_info.json", lambda found: found["splits"][0].update({where: value}))
    with pytest.raises(ValueError, match="press"):
        rlds.Reader(path)


def test_a_name_outside_the_folder(path, tmp_path):
    (file,) = path.glob("*array_record*")
    shutil.copy(file, tmp_path / "x-train.array_record-00000")
    edit(path / "dataset_info.json", lambda found: found.update(name="../x"))
    with pytest.raises(ValueError, match="press"):
        rlds.Reader(path)


def test_more_episodes_than_records(path):
    edit(path / "metadata.json", lambda found: found.update(parts=[10**12]))
    edit(path / "dataset_info.json", lambda i: i["splits"][0].update(shardLengths=[str(10**12)]))
    with pytest.raises(ValueError, match="expected 1000000000000"):
        rlds.Reader(path)


@pytest.mark.parametrize(
    "name",
    ["metadata.json", "features.json", "dataset_info.json", "press_piper-train.array_record-00000"],
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
