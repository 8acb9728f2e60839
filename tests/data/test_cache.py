"""The cache: data round-trip, and writes are atomic."""

import dataclasses
import json
import shutil
import zlib

import jax
import numpy as np
import pytest

from envs.datasets import rlds
from envs.datasets.episodes import Episodes
from lorasp_jax.base.digest import DIGEST, with_digest
from lorasp_jax.base.errors import REFUSED
from lorasp_jax.data import __main__ as command_line
from lorasp_jax.data import cache, rlds_export
from lorasp_jax.data.batches import flatten, gather
from lorasp_jax.data.lerobot import Keys, LeRobot
from lorasp_jax.data.opening import open_source, open_sources
from lorasp_jax.policies.statistics import Statistics
from tests.data.lerobots import GOLDEN, VERSIONS, digest, golden
from tests.runs import random_episodes


def quietly(done, total):
    assert 0 < done <= total


def written(folder, source):
    cache.write([source], folder, quietly)
    return cache.Cache(folder)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Episodes of two tasks, and a cache of them."""
    folder, parts = tmp_path_factory.mktemp("simulated"), []
    for number, task in enumerate(("press", "pour")):
        parts.append(random_episodes(task, number))
        rlds.write(parts[-1], folder / task)
    sources = open_sources([folder / part.task for part in parts], Keys())
    return parts, written(folder / "cache", sources)


def test_two_tasks_are_refused_as_rlds(simulated, tmp_path):
    with pytest.raises(ValueError, match="one task"):
        rlds_export.to_rlds(simulated[1], tmp_path / "rlds", pytest.fail)


@pytest.mark.parametrize("version", VERSIONS)
def test_windows_match_lerobot(version, tmp_path):
    """With the same padding and statistics."""
    found = written(tmp_path / "cache", LeRobot(golden(version)))
    with np.load(GOLDEN / f"lerobot_{version}" / "truth.npz") as truth:
        windows = gather(found.steps, truth["window_index"], 6)
        np.testing.assert_array_equal(windows.actions, truth["window_action"])
        np.testing.assert_array_equal(windows.inside, ~truth["window_action_is_pad"])
        np.testing.assert_array_equal(windows.state, truth["all/state"][truth["window_index"]])
        tasks = np.array(found.instructions)[found.steps.instruction]
        np.testing.assert_array_equal(tasks, truth["all/task"])
        index = truth["index"]
        difference = found.steps.image["wrist"][index].astype(int) - truth["wrist_uint8_hwc"]
        assert np.abs(difference).max() <= 3
    steps, valid = found.steps, np.ones(126, bool)
    measured = Statistics.measure(steps.state, steps.action, valid, slots=range(7), dim=7)
    with np.load(GOLDEN / "lerobot_v3" / "truth.npz") as truth:
        for name in ("mean", "std", "min", "max"):
            for key, known in (("observation.state", measured.state), ("action", measured.action)):
                wanted = truth[f"stats/{key}/{name}"]
                np.testing.assert_allclose(known[name], wanted, rtol=1e-6, atol=1e-6)


def test_steps_match_those_on_the_device(simulated):
    """Training reads the same from files as from the device."""
    parts, found = simulated
    expected = flatten(parts)
    np.testing.assert_array_equal(np.load(found.path / "state.npy"), expected.state)  # plain files
    table = np.array([text for part in parts for text in part.instructions])
    names = np.array(found.instructions)
    for name in ("state", "action", "end"):
        np.testing.assert_array_equal(getattr(found.steps, name), getattr(expected, name))
    np.testing.assert_array_equal(
        names[found.steps.instruction], table[np.asarray(expected.instruction)]
    )
    assert np.bincount(found.steps.dataset).tolist() == [21, 21]
    alone = dataclasses.replace(found.steps, dataset=None)
    assert jax.tree.structure(alone) == jax.tree.structure(expected)
    for name, picture in expected.image.items():
        np.testing.assert_array_equal(found.steps.image[name], picture)


def test_episodes_round_trip(simulated):
    parts, found = simulated
    assert (len(found), found.num_steps, found.control_dt) == (6, 42, 0.1)
    source, number = parts[1], 4 - 3
    episode = found.episode(4)
    episode.validate()
    length = source.length[number]
    np.testing.assert_array_equal(episode.action[0], source.action[number, :length])
    np.testing.assert_array_equal(episode.image["side"][0], source.image["side"][number, :length])
    assert episode.phrases[0] == source.instructions[1]
    assert (episode.task, episode.robot) == ("pour", "piper")
    assert found.episode(4, ()).image == {}


class Broken:
    """A source whose last episode cannot be read."""

    kind, cameras, control_dt, num_steps = "broken", ("side", "wrist"), 0.1, 10

    def __init__(self, *episodes: Episodes):
        self.episodes = episodes

    def __len__(self):
        return len(self.episodes) + 1

    def episode(self, number, cameras=None):
        if number == len(self.episodes):
            raise ValueError("the video ends")
        return self.episodes[number]


def one(**changes):
    return dataclasses.replace(random_episodes("press", 0).select([0]), **changes)


def test_a_failed_write_leaves_nothing(tmp_path, simulated):
    with pytest.raises(ValueError, match="the video ends"):
        written(tmp_path / "cache", Broken(one()))
    assert not list(tmp_path.iterdir())
    before = digest(simulated[1].path)
    with pytest.raises(ValueError, match="already exists"):
        written(simulated[1].path, Broken(one()))
    assert digest(simulated[1].path) == before
    empty = Broken()
    empty.__class__ = type("Empty", (Broken,), {"__len__": lambda _: 0})
    with pytest.raises(ValueError, match="no episode"):
        written(tmp_path / "cache", empty)


def test_a_full_disk_leaves_nothing(tmp_path, monkeypatch):
    class Full(cache.Column):
        def append(self, rows):
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(cache, "Column", Full)
    with pytest.raises(OSError, match="No space left"):
        written(tmp_path / "cache", Broken(one()))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"robot": "panda"}, "same robot, got 'piper' in the first episode and 'panda'"),
        ({"control_dt": 0.05}, r"same control_dt, got 0\.1"),
        ({"image": {"side": np.zeros((1, 9, 16, 32, 3), np.uint8)}}, "same cameras, got"),
        ({"state": np.zeros((1, 9, 8), np.float32)}, "action must have shape"),
        ({"action": np.full((1, 9, 7), np.nan, np.float32)}, "action is not finite"),
    ],
)
def test_incompatible_episodes_are_refused(changes, sentence, tmp_path):
    with pytest.raises(ValueError, match=sentence):
        written(tmp_path / "cache", Broken(one(), one(**changes)))
    assert not list(tmp_path.iterdir())


def test_a_damaged_image_is_not_copied(simulated, tmp_path):
    damaged = cache.Cache(shutil.copytree(simulated[1].path, tmp_path / "damaged"))
    file = damaged.path / "image_side.npy"
    content = bytearray(file.read_bytes())
    content[-50] ^= 1
    file.write_bytes(content)
    with pytest.raises(ValueError, match="image_side"):
        written(tmp_path / "copy", damaged)
    for to in ("lerobot", "rlds"):
        out = ("--to", to, "--out", str(tmp_path / "copy"))
        assert command_line.main(["convert", str(damaged.path), *out]) == REFUSED
    assert [path.name for path in tmp_path.iterdir()] == ["damaged"]


def test_damage_is_reported_in_one_sentence(simulated, tmp_path):
    for number, file in enumerate(sorted(simulated[1].path.iterdir())):
        for share in (0, 0.5, None):
            folder = tmp_path / f"{number} {share}"
            shutil.copytree(simulated[1].path, folder)
            whole = file.read_bytes()
            (folder / file.name).write_bytes(whole[: int(share * len(whole))] if share else b"")
            if share is None:
                (folder / file.name).unlink()
            with pytest.raises(ValueError, match=r"is damaged|is missing|is not a cache") as caught:
                cache.Cache(folder)
            assert "\n" not in str(caught.value)


def test_opening(tmp_path, simulated):
    assert open_source(golden("v3")).kind == "LeRobot v3.0"
    assert open_source(simulated[1].path).kind == "cache"
    assert open_source(simulated[1].path, Keys(image_size=64)).kind == "cache"
    for where, sentence in (
        (tmp_path, "is not a dataset: expected a folder"),
        (simulated[1].path.parent, f"such as {simulated[1].path}"),
        (tmp_path / "nothing", "does not exist"),
    ):
        with pytest.raises(ValueError, match=sentence):
            open_source(where)
    with pytest.raises(ValueError, match="not a LeRobot dataset"):
        open_source(simulated[1].path, Keys(angles="degrees"))


def test_chosen_cameras(simulated, tmp_path):
    """Of a cache, and of its copy."""
    path = simulated[1].path
    found = cache.Cache(path, ["wrist"])
    assert (list(found.cameras), found.left_out) == (["wrist"], {"side": "not chosen"})
    assert list(found.steps.image) == list(found.episode(0).image) == ["wrist"]
    assert found.metadata["crc32"].keys() == simulated[1].metadata["crc32"].keys() - {"image_side"}
    copy = written(tmp_path / "copy", found)
    assert (copy.metadata["crc32"], copy.left_out) == (found.metadata["crc32"], {})
    with pytest.raises(ValueError, match="no camera 'top': choose from side, wrist"):
        open_source(path, cameras=["top"])


@pytest.mark.parametrize(
    ("name", "change", "sentence"),
    [
        ("state", lambda x: x.astype(">f4"), "type, shape or checksum"),
        ("state", np.asfortranarray, "Fortran order"),
        ("action", lambda x: x * np.float32(np.nan), "not finite"),
        ("action", lambda x: np.concatenate([x, x[:1]]), "action has the shape"),
        ("state", lambda x: x[0, 0], "state has the shape"),
        ("instruction", lambda x: x[None], "instruction has the shape"),
        ("length", lambda x: x[:0], "must not be empty"),
        (
            "length",
            lambda x: x * np.where(np.arange(len(x)), 1, -1).astype(np.int32),
            "not be empty",
        ),
        ("task", lambda x: x[:-1], "task indices must be"),
        ("instruction", lambda x: x - np.int32(9), "instruction indices must be"),
        ("image_side", lambda x: x[:, :-1], "type, shape or checksum"),
    ],
)
def test_invalid_columns_are_refused(name, change, sentence, simulated, tmp_path):
    """Even if their checksums are correct."""
    folder = shutil.copytree(simulated[1].path, tmp_path / "cache")
    path = folder / f"{name}.npy"
    array = change(np.load(path))
    np.save(path, array)
    header = folder / cache.HEADER
    facts = json.loads(header.read_text())
    facts["crc32"][name] = zlib.crc32(array.tobytes())
    del facts[DIGEST]
    header.write_text(json.dumps(with_digest(facts)))
    with pytest.raises(ValueError, match=sentence):
        cache.Cache(folder)
