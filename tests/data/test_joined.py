"""Several datasets as one: joined, renamed, saved with their options, and drawn by weight."""

import dataclasses
import functools
import json
import os
from pathlib import Path

import jax
import numpy as np
import pytest

from envs.datasets import rlds
from lorasp_jax.data import cache, dataset_file
from lorasp_jax.data.__main__ import main
from lorasp_jax.data.batches import Mixture, draw, flatten
from lorasp_jax.data.cache import Cache
from lorasp_jax.data.joined import Joined
from lorasp_jax.data.keys import Keys
from lorasp_jax.data.opening import open_source, open_sources
from lorasp_jax.data.stream import Stream
from tests.data.lerobots import golden
from tests.runs import random_episodes

KEYS = Keys(image_size=32)


def quietly(done, total):
    assert 0 < done <= total


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The golden recordings, and an RLDS dataset whose cameras have other names."""
    folder = tmp_path_factory.mktemp("datasets")
    group = random_episodes("press", 0)
    image = {"cam_high": group.image["side"][:, :, :24], "extra": group.image["wrist"]}
    rlds.write(dataclasses.replace(group, image=image, physics_dt=0.0), folder / "rlds")
    (folder / "renamed.toml").write_text('path = "rlds"\n[cameras]\nside = "cam_high"\n')
    return folder


@pytest.fixture(scope="module")
def joined(folder):
    return open_sources([golden("v3"), folder / "renamed.toml"], KEYS)


def test_episodes_follow_each_other(joined, folder):
    first, second = open_source(golden("v3"), KEYS), open_source(folder / "rlds")
    assert [(part.name, part.episodes, part.cameras) for part in joined.parts] == [
        ("dataset", 4, ("side", "wrist")),
        ("renamed", 3, ("side",)),
    ]
    assert (len(joined), joined.num_steps) == (7, first.num_steps + second.num_steps)
    for number in range(7):
        found = joined.episode(number)
        source, own = (first, number) if number < 4 else (second, number - 4)
        expected = source.episode(own)
        np.testing.assert_array_equal(found.state, expected.state)
        name = "side" if number < 4 else "cam_high"
        np.testing.assert_array_equal(found.image["side"], expected.image[name])
        assert found.image["wrist"].any() == (number < 4)  # black where there is no camera
        texts = [e.phrases[0] for e in (found, expected)]
        assert texts[0] == texts[1]
        assert joined.episode(number, ("wrist",)).image.keys() == {"wrist"}
    assert "extra of rlds" not in joined.left_out  # `Renamed` says it without a name
    assert "extra of renamed" in joined.left_out


def test_a_cache_knows_what_it_was_joined_from(joined, tmp_path):
    cache.write([joined], tmp_path / "cache", quietly)
    found = Cache(tmp_path / "cache")
    assert found.parts == joined.parts
    assert found.dataset.tolist() == 4 * [0] + 3 * [1]
    assert np.bincount(found.steps.dataset).tolist() == [126, 21]
    for number in (0, 5):
        for name, image in joined.episode(number).image.items():
            np.testing.assert_array_equal(found.episode(number).image[name], image)
    assert [part.cameras for part in Cache(tmp_path / "cache", ["wrist"]).parts] == [("wrist",), ()]


def test_a_joined_cache_keeps_what_it_lacks(joined, folder, tmp_path):
    """Under other names of its cameras, too; joined again, black images would look recorded."""
    cache.write([joined], tmp_path / "cache", quietly)
    lines = 'path = "cache"\n[cameras]\na = "side"\nb = "wrist"\n'
    (tmp_path / "other.toml").write_text(lines)
    found = open_source(tmp_path / "other.toml")
    cache.write([found], tmp_path / "copy", quietly)
    for each in (found, Cache(tmp_path / "copy")):
        assert [part.cameras for part in each.parts] == [("a", "b"), ("a",)]
    with pytest.raises(ValueError, match="cache holds datasets of which some lack a camera"):
        open_sources([tmp_path / "cache", golden("v3")], KEYS)


def test_images_of_other_sizes_are_fitted_or_refused(folder, tmp_path):
    wide = random_episodes("press", 1)
    wide = dataclasses.replace(wide, image={"cam_high": wide.image["side"][:, :, :16]})
    rlds.write(wide, tmp_path / "wide")
    paths = [folder / "rlds", tmp_path / "wide"]
    with pytest.raises(
        ValueError, match=r"cam_high has 24 x 32 pixels in rlds and 16 x 32 .* wide"
    ):
        open_sources(paths, KEYS)
    square = lambda images: np.pad(images, [(0, 0), (0, 32 - images.shape[1]), (0, 0), (0, 0)])  # noqa: E731
    found = open_sources(paths, KEYS, ["cam_high"], square)
    assert [found.episode(n).image["cam_high"].shape[2:4] for n in (0, 3)] == 2 * [(32, 32)]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"control_dt": 0.05}, r"period of 0\.1 s and other of 0\.05 s: .*--every"),
        ({"actions": "delta_joint"}, "joint actions, but other has delta_joint"),
        (
            dict.fromkeys(("state", "action"), np.zeros((3, 9, 8), np.float32)),
            "7 and 7 numbers in one, but 8 and 8 in other: .*--state-numbers",
        ),
        (
            {"image": {"up": np.zeros((3, 9, 8, 8, 3), np.uint8)}},
            "cameras side, wrist and other up:",
        ),
    ],
)
def test_what_cannot_be_joined(changes, sentence, tmp_path):
    """The message names both datasets and what to do."""
    group = random_episodes("press", 0)
    rlds.write(group, tmp_path / "one")
    rlds.write(dataclasses.replace(group, **changes), tmp_path / "other")
    with pytest.raises(ValueError, match=sentence):
        open_sources([tmp_path / "one", tmp_path / "other"], KEYS)


def test_names(folder, tmp_path):
    rlds.write(random_episodes("press", 0), tmp_path / "rlds")
    with pytest.raises(ValueError, match="named twice"):
        open_sources([folder / "rlds", f"{folder}/../{folder.name}/rlds"], KEYS)
    with pytest.raises(ValueError, match=r"renamed\.toml is named twice, also as .*rlds"):
        open_sources([folder / "renamed.toml", golden("v3"), folder / "rlds"], KEYS)
    changed = random_episodes("press", 0)
    rlds.write(dataclasses.replace(changed, robot="so101"), tmp_path / "b" / "rlds")
    found = open_sources([tmp_path / "rlds", tmp_path / "b" / "rlds"], KEYS)
    assert [part.name for part in found.parts] == [str(tmp_path / p) for p in ("rlds", "b/rlds")]
    episode = found.episode(5, ())
    assert (episode.robot, episode.physics_dt, episode.task) == ("piper + so101", 0.005, "press")


def test_inspect_saves_what_other_commands_read(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    options = ["--angles", "degrees", "--every", "2", "--grippers", "gripper", "--out", "x.png"]
    options += ["--cameras", "top=observation.images.side"]
    assert main(["inspect", str(golden("v3")), *options, "--save", "my.toml"]) == 0
    text = (tmp_path / "my.toml").read_text()
    assert not {"state", "action", "gripper", "image_size"} & {
        x.split(" ")[0] for x in text.split("\n")
    }
    path, keys = dataset_file.read("my.toml", 64)
    cameras = {"top": "observation.images.side"}
    assert keys == Keys(
        angles="degrees", every=2, grippers=("gripper",), cameras=cameras, image_size=64
    )
    assert open_source("my.toml").episode(0, ()).task == "my"
    monkeypatch.chdir("/")  # the path is relative to the file
    assert open_source(tmp_path / "my.toml").control_dt == pytest.approx(0.2)
    assert path.startswith("..")
    out = ["--out", str(tmp_path / "cache")]
    assert main(["convert", str(tmp_path / "my.toml"), *out]) == 0
    assert list(Cache(tmp_path / "cache").cameras) == ["top"]
    for option in (["--angles", "degrees"], ["--angles", "radians"], ["--every", "1"]):
        assert main(["inspect", str(tmp_path / "my.toml"), *option]) == 2  # defaults, too
        message = capsys.readouterr().err
        assert f"{option[0]} is one of the dataset's options, which {tmp_path}/my.toml" in message
    with pytest.raises(ValueError, match="change them there"):
        open_source(tmp_path / "my.toml", Keys(every=3))
    assert main(["inspect", str(golden("v3")), "--save", str(tmp_path / "my.toml")]) == 2


def test_a_dataset_file_in_a_linked_folder_finds_its_dataset(tmp_path):
    (tmp_path / "far" / "away").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "far" / "away")
    (tmp_path / "data").mkdir()
    (tmp_path / "latest").symlink_to("data")
    for name in ("data", "latest"):  # what a link leads to may change, the link stays
        dataset_file.write(tmp_path / "link" / "my.toml", str(tmp_path / name), Keys())
        path, _ = dataset_file.read(tmp_path / "link" / "my.toml", 0)
        assert os.path.samefile(path, tmp_path / "data")
        assert Path(path).name == name


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('path = "x"\nangels = "degrees"', "no field 'angels' .*'angles'"),
        ('angles = "degrees"', "must say where the dataset is"),
        ('path = "x"\nevery = "2"', r"my\.toml: every must be int"),
        ('path = "x"\nangles = "turns"', r"my\.toml: angles must be one of"),
        ('path = "x"\ncameras = ["a"]', "cameras must map"),
        ('path = "x"\nimage_size = 3', "no field 'image_size'"),
        ("path = ", r"my\.toml is damaged"),
        ('path = "x"', "x does not exist"),
        (f"path = {json.dumps(str(golden('v3')))}\n[cameras]\na = 'b'", "no color camera b"),
    ],
)
def test_a_wrong_dataset_file_is_refused_in_one_sentence(text, sentence, tmp_path):
    (tmp_path / "my.toml").write_text(text)
    with pytest.raises(ValueError, match=sentence) as caught:
        open_source(tmp_path / "my.toml")
    assert "\n" not in str(caught.value)


def test_other_formats_have_cameras_alone(folder, tmp_path):
    found = open_source(folder / "renamed.toml", cameras=["side"])
    assert list(found.cameras) == ["side"]
    with pytest.raises(ValueError, match="no camera 'top': choose from side"):
        open_source(folder / "renamed.toml", cameras=["top"])
    for option in ('angles = "degrees"', "[cameras]\nside = 'nothing'"):
        (tmp_path / "my.toml").write_text(f"path = {json.dumps(str(folder / 'rlds'))}\n{option}")
        with pytest.raises(ValueError, match=r"is not a LeRobot dataset|no camera 'nothing'"):
            open_source(tmp_path / "my.toml")


@pytest.fixture(scope="module")
def mixture():
    """42 numbered windows: 6 of a first dataset, drawn thrice as often as the 36 of the other."""
    steps = flatten([random_episodes("a", 0), random_episodes("b", 1)])
    state = np.array(steps.state)
    state[:, 0] = np.arange(42)
    shares = np.array([0.75, 0.25], np.float32)
    bounds = np.array([0, 6, 42], np.int32)
    return dataclasses.replace(steps, state=state, mixture=Mixture(bounds, shares))


def test_drawn_by_weight(mixture):
    """On the device: each dataset by its share, each of its windows equally often."""
    count = 200_000
    small = dataclasses.replace(mixture, image={})
    drawn = jax.jit(functools.partial(draw, batch_size=count, chunk=1))(jax.random.key(0), small)
    windows = np.bincount(np.asarray(drawn.state[:, 0], int), minlength=42) / count
    expected = np.repeat([0.75 / 6, 0.25 / 36], [6, 36])
    assert np.all(np.abs(windows - expected) < 5 * np.sqrt(expected / count))


def test_streamed_by_weight(mixture):
    """In turns; every window of a dataset once in an epoch of it; resumes at any position."""

    def stream(start=0, process=(0, 1)):
        return Stream(mixture, batch_size=8, chunk=4, seed=3, start=start, process=process)

    def numbers(stream, batches):
        return np.stack([next(stream).state[:, 0] for _ in range(batches)]).astype(int)

    whole = numbers(stream(), 18)  # 144 windows: 108 and 36
    assert ((whole < 6).sum(), (whole >= 6).sum()) == (108, 36)
    np.testing.assert_array_equal(np.sort(whole[whole >= 6]), np.arange(6, 42))
    assert set(np.bincount(whole[whole < 6])) == {18}
    np.testing.assert_array_equal(numbers(stream(start=5), 13), whole[5:])
    halves = [numbers(stream(process=(i, 2)), 18) for i in range(2)]
    np.testing.assert_array_equal(np.concatenate(halves, -1), whole)


def test_images_of_a_damaged_cache_are_not_joined(folder, tmp_path):
    for name in ("a", "b"):
        cache.write([open_source(folder / "rlds")], tmp_path / name, quietly)
    file = tmp_path / "b" / "image_extra.npy"
    content = bytearray(file.read_bytes())
    content[-50] ^= 1
    file.write_bytes(content)
    sources = {name: Cache(tmp_path / name) for name in ("a", "b")}
    for joined in ([*sources.values()], [Joined(sources)]):
        with pytest.raises(ValueError, match="image_extra"):
            cache.write(joined, tmp_path / "copy", quietly)
