"""LeRobot datasets, compared with LeRobot's own readers."""

import io
import math

import numpy as np
import pyarrow as pa
import pytest
from PIL import Image

from lorasp_jax.data.lerobot import Keys, LeRobot
from tests.data.lerobots import (
    GOLDEN,
    VERSIONS,
    copied,
    cut,
    edit_info,
    edit_rows,
    golden,
    replaced,
    set_value,
)


def read_all(folder, keys=None, cameras=None):
    dataset = LeRobot(folder, keys)
    return [dataset.episode(number, cameras) for number in range(len(dataset))]


@pytest.mark.parametrize("version", VERSIONS)
def test_data_match_lerobot(version):
    dataset = LeRobot(golden(version))
    episodes = [dataset.episode(number) for number in range(len(dataset))]
    with np.load(GOLDEN / f"lerobot_{version}" / "truth.npz") as truth:
        for name in ("state", "action"):
            found = np.concatenate([getattr(e, name)[0] for e in episodes])
            np.testing.assert_array_equal(found, truth[f"all/{name}"])
        steps = [(e.phrases[0], n) for e in episodes for n in e.length]
        tasks = np.concatenate([[task] * n for task, n in steps])
        np.testing.assert_array_equal(tasks, truth["all/task"])
        for row, (episode, frame) in enumerate(
            zip(truth["episode_index"], truth["frame_index"], strict=True)
        ):
            for camera in ("side", "wrist"):
                found = episodes[episode].image[camera][0, frame].astype(int)
                wanted = truth[f"{camera}_uint8_hwc"][row]
                # Other releases of the decoder may round colors differently; a wrong frame
                # differs by 200.
                assert np.abs(found - wanted).max() <= 3
    assert len(dataset) == 4
    assert dataset.num_steps == sum(e.num_steps for e in episodes) == 126
    assert (dataset.control_dt, episodes[0].robot) == (0.1, "piper")
    for episode in episodes:
        episode.validate()


def test_reading_order_does_not_matter():
    """Jumping back or ahead in a video seeks."""
    dataset = LeRobot(golden("v3"))
    forwards = [dataset.episode(number, ["side"]).image["side"] for number in range(4)]
    for number in (2, 0, 3, 1, 1):
        found = dataset.episode(number, ["side"]).image["side"]
        np.testing.assert_array_equal(found, forwards[number])


def test_dimensions_are_selected_and_converted(tmp_path):
    """Selecting and converting a larger state in degrees and mm restores the golden one."""
    folder = copied("v3", tmp_path)

    def widen(table):
        state = np.array(table["observation.state"].to_pylist())
        native = np.concatenate([np.rad2deg(state[:, :6]), 1000 * state[:, 6:]], axis=1)
        rows = np.insert(native, 3, -7.0, axis=1).tolist()
        wide = replaced(table, "observation.state", pa.array(rows, pa.list_(pa.float64())))
        action = np.array(table["action"].to_pylist())
        native = np.concatenate([np.rad2deg(action[:, :6]), 1000 * action[:, 6:]], axis=1)
        return replaced(wide, "action", pa.array(native.tolist(), pa.list_(pa.float64())))

    def describe(info):
        names = [*(f"joint_{i}.pos" for i in (1, 2, 3)), "torque"]
        names += [*(f"joint_{i}.pos" for i in (4, 5, 6)), "gripper.pos"]
        info["features"]["observation.state"] |= {"shape": [8], "names": {"motors": names}}

    edit_rows(folder, widen)
    edit_info(folder, describe)
    whole = LeRobot(folder)
    assert [len(whole.names[kind]) for kind in ("state", "action")] == [8, 7]
    assert whole.episode(0, ()).state.shape[2] == 8
    assert whole.episode(0, ()).action.shape[2] == 7
    joints = tuple(f"joint_{i + 1}.pos" for i in range(6))
    for chosen in ((*joints, "gripper.pos"), ("0", "1", "2", "4", "5", "6", "7")):
        keys = Keys(state_numbers=chosen, angles="degrees", gripper="millimetres")
        for found, wanted in zip(
            read_all(folder, keys, ()), read_all(golden("v3"), cameras=()), strict=True
        ):
            np.testing.assert_allclose(found.state, wanted.state, atol=1e-6)
            np.testing.assert_allclose(found.action, wanted.action, atol=1e-6)


def test_kept_frames_get_the_last_action_before_the_next():
    (whole, *_), (found, *_) = read_all(golden("v21")), read_all(golden("v21"), Keys(every=3))
    assert found.num_steps == 9  # of 25
    np.testing.assert_array_equal(found.state[0], whole.state[0, ::3])
    np.testing.assert_array_equal(found.action[0, :8], whole.action[0, 2:24:3])
    np.testing.assert_array_equal(found.action[0, 8], whole.action[0, 24])
    np.testing.assert_array_equal(found.image["side"][0], whole.image["side"][0, ::3])
    assert found.control_dt == pytest.approx(0.3)


def test_cameras_are_selected_and_images_downscaled():
    keys = Keys(cameras={"main": "observation.images.wrist"}, image_size=64)
    (found, *_), (whole, *_) = read_all(golden("v3"), keys), read_all(golden("v3"))
    assert list(found.image) == ["main"]
    assert found.image["main"].shape == (1, 25, 48, 64, 3)
    blocks = whole.image["wrist"].reshape(1, 25, 48, 2, 64, 2, 3).mean((3, 5))
    assert np.abs(found.image["main"] - blocks).mean() < 4


def test_images_in_columns(tmp_path):
    """Datasets without videos store PNG files in parquet columns."""
    folder, key = copied("v21", tmp_path), "observation.images.side"
    (wanted, *_) = read_all(golden("v21"), cameras=["side"])

    def png(picture):
        file = io.BytesIO()
        Image.fromarray(picture).save(file, "png")
        return {"bytes": file.getvalue(), "path": None}

    files = [png(picture) for picture in wanted.image["side"][0]]
    edit_rows(folder, lambda t: t.append_column(key, pa.array(files)))
    edit_info(folder, lambda info: info["features"][key].update(dtype="image"))
    found = LeRobot(folder).episode(0)
    np.testing.assert_array_equal(found.image["side"], wanted.image["side"])
    assert list(found.image) == ["side", "wrist"]
    edit_rows(folder, set_value(key, 3, lambda file: file | {"bytes": file["bytes"][:100]}))
    with pytest.raises(ValueError, match=r"000000\.parquet is damaged"):
        LeRobot(folder).episode(0)


BROKEN = {
    "no feature": (lambda f: edit_info(f, lambda i: i["features"].pop("action")), "'action'"),
    "no pictures": (
        lambda f: edit_info(f, lambda i: [i["features"].pop(k) for k in [*i["features"]][2:4]]),
        "no color camera",
    ),
    "one short row": (lambda f: edit_rows(f, set_value("action", 3, lambda x: x[:-1])), "action"),
    "no number": (
        lambda f: edit_rows(f, set_value("observation.state", 3, lambda x: [*x[:-1], math.nan])),
        "step 3, dimension 6",
    ),
    "mixed fps": (
        lambda f: edit_rows(f, set_value("timestamp", 20, lambda x: x / 2)),
        "episode 0 .* fps",
    ),
    "lost frame": (lambda f: edit_rows(f, lambda t: t.slice(1)), "frames 0 to 24"),
    "cut video": (lambda f: cut(f, "*.mp4", 0.6), "mp4 is damaged"),
}


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("name", BROKEN)
def test_broken_datasets_are_refused(name, version, tmp_path):
    """See also `tests.test_malformed`."""
    change, word = BROKEN[name]
    folder = copied(version, tmp_path)
    change(folder)
    with pytest.raises(ValueError, match=word):
        read_all(folder)


def test_a_video_of_another_frame_rate(tmp_path):
    """The metadata say where an episode of version 3.0 starts: at a frame, not between two."""
    folder = copied("v3", tmp_path)
    name = "videos/observation.images.side/from_timestamp"
    edit_rows(folder, set_value(name, 1, lambda time: time + 0.05), of="meta/episodes")
    dataset = LeRobot(folder)
    dataset.episode(0)
    with pytest.raises(ValueError, match="10 fps"):
        dataset.episode(1)


@pytest.mark.parametrize(
    "keys",
    [
        {"cameras": {"side": "observation.images.front"}},
        {"state": "observation.qpos"},
        {"state_numbers": ("joint_1", "joint_9")},
    ],
)
def test_wrong_keys_list_the_available_ones(keys):
    with pytest.raises(ValueError, match=r"images\.side|qpos|joint_9.*joint_6"):
        LeRobot(golden("v3"), Keys(**keys))
    with pytest.raises(ValueError, match="every"):
        Keys(every=0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("state", 5),
        ("state_numbers", "01"),
        ("action_numbers", (0, 1)),
        ("cameras", ["observation.images.side"]),
        ("cameras", {1: "observation.images.side"}),
        ("cameras", {"side": None}),
        ("angles", "Degrees"),
        ("gripper", "mm"),
        ("every", 1.5),
        ("every", True),
        ("image_size", 10**30),
    ],
)
def test_types_of_keys(name, value):
    """An unknown unit must not be taken for radians or meters."""
    with pytest.raises(ValueError, match=name):
        Keys(**{name: value})
