"""Summaries and contact sheets match the dataset."""

import dataclasses
import io

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from lorasp_jax.config import Config
from lorasp_jax.data import inspection
from lorasp_jax.data.lerobot import Keys, LeRobot
from tests.data.lerobots import GOLDEN, copied, edit_info, golden


@pytest.fixture(scope="module")
def source():
    return LeRobot(golden("v3"))


def test_summary(source):
    found = inspection.summarize(source)
    with np.load(GOLDEN / "lerobot_v3" / "truth.npz") as truth:
        np.testing.assert_array_equal(found.state, truth["all/state"])
        np.testing.assert_array_equal(found.action, truth["all/action"])
    assert found.length.tolist() == [25, 33, 40, 28]
    assert found.phrases == {
        "pick up the red cube and place it in the basket": 2,
        "press the green button": 2,
    }
    assert not inspection.hints(found.state, found.grippers)


def test_another_period_than_that_of_training_is_said(source, monkeypatch):
    for period, is_said in ((source.control_dt, False), (0.05, True)):
        monkeypatch.setattr(Config, "control_dt", period)
        text = io.StringIO()
        inspection.report(source, Console(file=text))
        assert ("--control-dt 0.1" in text.getvalue()) == is_said


def test_a_gripper_alone_has_no_joints(source):
    found = inspection.summarize(source)
    (hint,) = inspection.hints(2 + found.state[:, 6:], [0])
    assert "--gripper millimetres" in hint


@pytest.mark.parametrize("actions", ["joint", "end_effector"])
def test_dimensions_have_names(actions, source):
    episode = dataclasses.replace(source.episode(0, ()), actions=actions)
    joints = [f"joint_{number}" for number in range(1, 7)]
    found = inspection._names(episode)
    assert found["state"] == [*joints, "gripper"]
    assert found["action"] == [
        *(joints if actions == "joint" else inspection._END_EFFECTOR),
        "gripper",
    ]
    assert inspection.summarize(source).names["action"] == [*joints, "gripper"]
    chosen = LeRobot(golden("v3"), Keys(state_numbers=("gripper", "0"), action_numbers=("6", "1")))
    assert chosen.names == {"state": ["gripper", "joint_1"], "action": ["gripper", "joint_2"]}


def test_wrong_units_give_hints(source):
    found = inspection.summarize(source)
    scale = np.array([57.3] * 6 + [1000], np.float32)
    degrees, millimetres = inspection.hints(found.state * scale, found.grippers)
    assert "--angles degrees" in degrees
    assert "--gripper millimetres" in millimetres
    (hint,) = inspection.hints(np.tile(found.state * [*[1] * 6, 100], 2), [6, 13])
    assert "--gripper millimetres" in hint


def test_contact_sheet(source, tmp_path):
    """One row per episode; the bar at the bottom of each image identifies the frame."""
    path = tmp_path / "sheet.png"
    inspection.write_contact_sheet(source, path)
    with Image.open(path) as picture:
        sheet = np.asarray(picture).astype(int)
    title, sheet = np.split(sheet, [2 * inspection.LINE])
    names = [title[inspection.LINE :, x : x + 128] for x in range(0, len(title[0]), 128)]
    sheet = np.concatenate([title[: inspection.LINE], sheet])
    row = inspection.LINE + 96 + 2
    assert sheet.shape == (4 * row, inspection.FRAMES * (2 * 128 + 2), 3)
    assert [(name > 200).any() for name in names[:4]] == 4 * [True]
    assert (names[0] != names[1]).any()
    red = (sheet[..., 0] > 180) & (sheet[..., 1] < 80)
    widths = [red[(number + 1) * row - 6, :128].sum() for number in range(4)]
    assert np.allclose(np.diff(widths), widths[0], atol=2)
    assert widths[0] > 10
    white = (sheet[inspection.LINE + 4] > 200).all(-1).reshape(inspection.FRAMES, -1)
    assert (np.diff(white[:, :128].sum(-1)) > 10).all()  # in time order from left to right
    assert [file.name for file in tmp_path.iterdir()] == ["sheet.png"]


def test_images_of_any_shape_are_downscaled(tmp_path):
    """Instructions in any script are accepted."""
    folder = copied("v21", tmp_path)
    tasks = folder / "meta" / "tasks.jsonl"
    tasks.write_text(tasks.read_text().replace("green button", "绿色按钮"))
    edit_info(folder, lambda info: info["features"].pop("observation.images.wrist"))
    sheet = inspection.contact_sheet(LeRobot(folder, Keys(image_size=32)))
    height = inspection.LINE + 4 * (inspection.LINE + 24 + 2)
    assert sheet.shape == (height, inspection.FRAMES * 34, 3)


@pytest.mark.parametrize("count", [1, 2, 5, 6, 7, 100])
def test_indices_are_evenly_spread(count):
    found = inspection._spread(count, 6)
    assert found[0] == 0
    assert found[-1] == count - 1
    assert len(found) == len(set(found)) == min(count, 6)
