"""RLDS datasets: data round-trip, here and in plain tfds, and writes are atomic."""

import dataclasses
import os
import resource
import shutil
import sys

import jax
import numpy as np
import pytest
import tensorflow_datasets as tfds

from envs.datasets import rlds, rlds_schema
from envs.datasets.episodes import Episodes, concatenate
from tests.envs.datasets.test_episodes import assert_equal, make


def trimmed(episodes: Episodes) -> Episodes:
    """Return episodes as they are read: padded with zeros to the longest one, all successes."""
    successes = np.ones(episodes.num_episodes, np.int32)
    episodes = dataclasses.replace(episodes, success=successes)
    longest = int(np.max(episodes.length))

    def blank(array):
        array = np.array(array)
        if array.ndim > 1:
            array = array[:, :longest]
            for row, length in zip(array, episodes.length, strict=True):
                row[length:] = 0
        return array

    return jax.tree.map(blank, episodes)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "new folder" / "press"


def test_round_trip(path):
    episodes = make(5, 9)
    rlds.write(jax.tree.map(jax.numpy.asarray, episodes), path)  # device arrays too
    assert_equal(rlds.read(path), trimmed(episodes))
    assert os.listdir(path.parent) == ["press"]


def test_one_episode_at_a_time(path):
    wanted = make()
    rlds.write(wanted, path)
    found = rlds.Reader(path)
    assert (len(found), found.num_steps, found.control_dt, found.kind) == (3, 6, 0.1, "RLDS")
    for number in (2, 0):
        length = int(wanted.length[number])
        one = wanted.select([number])
        short = dataclasses.replace(
            one,
            image={name: picture[:, :length] for name, picture in one.image.items()},
            state=one.state[:, :length],
            action=one.action[:, :length],
            attempted=1,
            success=np.ones(1, np.int32),
        )
        assert_equal(found.episode(number), short)
        assert_equal(found.episode(number, ()), dataclasses.replace(short, image={}))
        (camera,) = found.episode(number, ["wrist"]).image
        assert camera == "wrist"
    chosen = rlds.Reader(path, ["wrist"])
    assert (list(chosen.cameras), chosen.left_out) == (["wrist"], {"side": "not chosen"})
    assert list(chosen.episode(0).image) == ["wrist"]
    with pytest.raises(ValueError, match="no camera 'top': choose from side, wrist"):
        rlds.Reader(path, ["top"])
    with pytest.raises(ValueError, match="only once, got side, side"):
        rlds.Reader(path, ["side", "side"])


def test_other_cameras_robots_and_actions(path):
    episodes = make(
        state=np.ones((3, 4, 8), np.float32),
        actions="end_effector",
        robot="panda",
        control_dt=0.02,
        image={"top": np.full((3, 4, 5, 7, 3), 9, np.uint8)},
    )
    rlds.write(episodes, path)
    assert_equal(rlds.read(path), trimmed(episodes))
    form = rlds_schema.features(rlds.metadata(path))["steps"]
    assert "joint_7 [rad], gripper opening [m]" in form["observation"]["state"].doc.desc
    assert "rotation vector" in form["action"].doc.desc
    assert set(form["observation"]) == {"top_image", "state"}


def test_plain_tfds_reads_it_without_tensorflow(path):
    episodes = make(3, 5, length=np.array([2, 4, 5], np.int32))
    rlds.write(episodes, path)
    builder = tfds.builder_from_directory(path)
    source = builder.as_data_source("train")
    episode, steps = source[1]["episode_metadata"], [*source[1]["steps"]]
    assert "tensorflow" not in sys.modules
    assert len(source) == 3
    assert (episode["episode_id"], episode["task"]) == (1, b"press")
    assert episode["control_dt"] == pytest.approx(0.1)
    assert tuple(builder.info.metadata["instructions"]) == episodes.instructions
    assert steps[-1]["language_instruction"].decode() == episodes.instructions[1]
    for name in ("reward", "is_last", "is_terminal"):
        assert [step[name] for step in steps] == [0, 0, 0, 1]
    assert [step["is_first"] for step in steps] == [1, 0, 0, 0]
    assert [step["discount"] for step in steps] == [1, 1, 1, 1]
    seen = [step["observation"] | {"action": step["action"]} for step in steps]
    for name, expected in (
        ("image", episodes.image["side"]),
        ("wrist_image", episodes.image["wrist"]),
        ("state", episodes.state),
        ("action", episodes.action),
    ):
        np.testing.assert_array_equal(np.stack([step[name] for step in seen]), expected[1, :4])


def test_a_copy_with_the_names_of_tfds_is_read(path):
    rlds.write(make(), path)
    (file,) = path.glob("*array_record*")
    file.rename(path / "press-train.array_record-00000-of-00001")
    assert_equal(rlds.read(path), trimmed(make()))


def test_existing_files_are_not_touched(path):
    rlds.write(make(), path)
    with pytest.raises(ValueError, match="already exists"):
        rlds.write(make(2), path)
    assert rlds.read(path).num_episodes == 3


def damage(file, how):
    whole = bytearray(file.read_bytes())
    middle = whole.index(b"PNG")
    if how == "flipped":
        whole[middle + 50] ^= 0xFF
    file.write_bytes(whole[: {"flipped": None, "cut": middle, "empty": 0}[how]])


def test_foreign_folders(tmp_path, path):
    with pytest.raises(ValueError, match="missing"):
        rlds.read(path)
    rlds.write(make(), path)
    (path / "dataset_info.json").unlink()
    with pytest.raises(ValueError, match=r"dataset_info.json is missing"):
        rlds.read(path)
    for text in ("{", "[]", '{"format": "other"}'):
        (path / "metadata.json").write_text(text)
        with pytest.raises(ValueError, match="press is damaged"):
            rlds.read(path)
    with pytest.raises(ValueError, match=r"metadata\.json is missing"):
        rlds.read(tmp_path)


def test_shards_add_up(tmp_path):
    folder, options = tmp_path / "parts", {"seed": 0}
    first, second = make(2, 3), make(3, 5)
    parts = rlds.ShardWriter(folder, options)
    parts.append(first)
    shutil.copytree(folder, tmp_path / "copy")
    parts.append(second)

    # As after a kill while the second shard was written, and resumed.
    again = rlds.ShardWriter(tmp_path / "copy", options)
    assert (again.num_episodes, again.attempted) == (2, 3)
    (torn,) = {file.name for file in folder.iterdir()} - {p.name for p in again.folder.iterdir()}
    (again.folder / torn).write_bytes(b"half")
    again.append(second)
    for each in (parts, again):
        each.complete()
        assert_equal(rlds.read(each.folder), trimmed(concatenate([first, second])))


@pytest.mark.parametrize("content", [None, b"half", b""])
def test_a_shard_that_was_not_completed_hides_no_earlier_ones(tmp_path, content):
    """A recording is used while it grows; a process may be killed in its next episode."""
    parts = rlds.ShardWriter(tmp_path / "parts", {})
    parts.append(make(2))
    parts.complete()
    before = (parts.folder / rlds.METADATA).read_bytes()
    parts.append(make(3))
    if content is not None:
        sorted(parts.folder.glob("*array_record*"))[1].write_bytes(content)
    (parts.folder / rlds.METADATA).write_bytes(before)
    assert_equal(rlds.read(parts.folder), trimmed(make(2)))


def test_shards_must_match(tmp_path):
    parts = rlds.ShardWriter(tmp_path / "parts", {"seed": 0})
    parts.append(make())
    with pytest.raises(ValueError, match="seed 0, not 1"):
        rlds.ShardWriter(parts.folder, {"seed": 1})
    small = {name: np.zeros((3, 4, 2, 2, 3), np.uint8) for name in ("side", "wrist")}
    for changes, message in (
        ({"robot": "panda"}, "robot 'piper', not 'panda'"),
        ({"image": small}, r"cameras .*\[6, 8\]"),
    ):
        with pytest.raises(ValueError, match=message):
            parts.append(make(**changes))
    assert rlds.ShardWriter(parts.folder, {"seed": 0}).num_episodes == 3


@pytest.mark.parametrize("how", ["flipped", "cut", "empty", "missing"])
def test_a_damaged_shard_is_refused(tmp_path, how):
    parts = rlds.ShardWriter(tmp_path / "parts", {})
    parts.append(make(2))
    (file,) = parts.folder.glob("*array_record*")
    damage(file, how) if how != "missing" else file.unlink()
    with pytest.raises(ValueError, match=r"0 is (damaged \(.*\)|missing): delete .*parts to"):
        rlds.ShardWriter(parts.folder, {})


def test_shards_of_another_dataset_are_detected(tmp_path):
    one, two = (rlds.ShardWriter(tmp_path / name, {}) for name in ("one", "two"))
    one.append(make(2))
    two.append(make(3))
    (file,) = one.folder.glob("*array_record*")
    os.replace(file, two.folder / file.name)
    with pytest.raises(ValueError, match="expected 3 episodes"):
        rlds.ShardWriter(two.folder, {})


def test_a_full_disk_keeps_earlier_shards(tmp_path):
    folder = tmp_path / "parts"
    parts = rlds.ShardWriter(folder, {})
    parts.append(make(2))
    facts = rlds.metadata(folder)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(OSError, match=r"cannot write .* \(write\(\) failed: [^;\n]*\)$"):
            parts.append(make(60))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert rlds.metadata(folder) == facts
    again = rlds.ShardWriter(folder, {})
    again.append(make(60))
    assert again.num_episodes == 62
