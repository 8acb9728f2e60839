"""What a LeRobot dataset marks about its features is read; names are unique or refused."""

import io
import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from lorasp_jax.data import lerobot_features
from lorasp_jax.data.__main__ import main
from lorasp_jax.data.keys import Keys
from lorasp_jax.data.lerobot import LeRobot
from tests.data.lerobots import VERSIONS, copied, edit_info, edit_rows, golden, replaced

SIDE, WRIST = "observation.images.side", "observation.images.wrist"
JOINTS = [f"joint_{i + 1}" for i in range(6)]
STATE = np.concatenate([e.state[0] for e in map(LeRobot(golden("v21")).episode, range(1))])


@pytest.fixture
def folder(tmp_path):
    return copied("v21", tmp_path)


def mark(folder, feature, **marks):
    edit_info(folder, lambda info: info["features"][feature].update(marks))


def name(folder, names):
    for key in ("observation.state", "action"):
        mark(folder, key, names=names)


def pictures(folder, encode):
    """Store the side camera's pictures of episode 0 in a column."""
    found = LeRobot(golden("v21")).episode(0, ["side"]).image["side"][0]
    column = pa.array([encode(number, picture) for number, picture in enumerate(found)])
    edit_rows(folder, lambda table: table.append_column(SIDE, column))
    mark(folder, SIDE, dtype="image")
    return found


def encoded(picture, kind="png"):
    file = io.BytesIO()
    Image.fromarray(picture).save(file, kind)
    return file.getvalue()


@pytest.mark.parametrize(
    ("marks", "reason"),
    [
        ({"info": {"is_depth_map": True, "depth_unit": "mm"}}, "depth"),
        ({"info": {"video.is_depth_map": True}}, "depth"),
        ({"info": None, "video_info": {"video.is_depth_map": True}}, "depth"),
        ({"info": {"video.pix_fmt": "gray16le"}}, "one channel"),
        ({"info": {"video.channels": 1}}, "one channel"),
        ({"shape": [96, 128, 1]}, "one channel"),
        ({"shape": [1, 96, 128]}, "one channel"),
        ({"dtype": "image", "shape": [96, 128]}, "one channel"),
    ],
)
def test_depth_is_no_color_camera(marks, reason, folder, capsys, tmp_path):
    mark(folder, SIDE, **marks)
    dataset = LeRobot(folder)
    assert (dataset.cameras, dataset.left_out) == ({"wrist": WRIST}, {"side": reason})
    assert list(dataset.episode(0).image) == ["wrist"]
    for options in ({"keys": Keys(cameras={"top": SIDE})}, {"cameras": ("side",)}):
        with pytest.raises(ValueError, match=rf"side.*{reason}"):
            LeRobot(folder, **options)
    assert main(["inspect", str(folder), "--out", str(tmp_path / "sheet.png")]) == 0
    assert f"left out: side ({reason})\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    "dtype", [np.uint16, np.uint8, np.float32], ids=["16 bit", "8 bit", "TIFF"]
)
def test_unmarked_pictures_of_one_channel(dtype, folder):
    kind = "tiff" if dtype is np.float32 else "png"

    def encode(number, picture):
        return {"bytes": encoded(picture[..., 0].astype(dtype), kind), "path": None}

    pictures(folder, encode)
    word = "neither PNG nor JPEG" if kind == "tiff" else "one channel"
    with pytest.raises(ValueError, match=rf"{SIDE} .*{word}"):
        LeRobot(folder).episode(0)
    assert LeRobot(folder, cameras=["wrist"]).episode(0).num_steps == 25


def test_pictures_by_path_and_as_bytes(folder):
    def by_path(number, picture):
        path = folder / "images" / f"{number}.png"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(encoded(picture))
        return {"bytes": None, "path": f"images/{number}.png"}

    wanted = pictures(folder, by_path)
    np.testing.assert_array_equal(LeRobot(folder).episode(0).image["side"][0], wanted)
    (folder / "images" / "3.png").unlink()
    with pytest.raises(ValueError, match=r"3\.png is missing"):
        LeRobot(folder).episode(0)

    def replace(cells):
        edit_rows(folder, lambda table: replaced(table, SIDE, pa.array(cells)))

    replace([encoded(picture) for picture in wanted])
    np.testing.assert_array_equal(LeRobot(folder).episode(0).image["side"][0], wanted)
    for cell, words in (
        ({"bytes": None, "path": None}, "missing"),
        ({"bytes": None, "path": "/etc/passwd"}, "stay in the folder"),
        ([[[0, 0, 0]]], "list.* neither a PNG"),
    ):
        replace([cell] * 25)
        with pytest.raises(ValueError, match=words):
            LeRobot(folder).episode(0)


def test_numbers_with_and_without_lists(folder):
    """LeRobot stores features of shape [1] as plain numbers; others have lists in lists."""

    def change(table):
        for key in ("observation.state", "action"):
            table = replaced(table, key, pa.array([[row] for row in table[key].to_pylist()]))
        for key in ("frame_index", "episode_index", "task_index", "timestamp"):
            table = replaced(table, key, pa.array([[x] for x in table[key].to_pylist()]))
        return table

    edit_rows(folder, change)
    for key in ("observation.state", "action"):
        mark(folder, key, shape=[1, 7])
    np.testing.assert_array_equal(LeRobot(folder).episode(0, ()).state[0], STATE)
    mark(folder, "action", shape=[50, 7])
    with pytest.raises(ValueError, match=r"one vector per frame, but has shape \[50, 7\]"):
        LeRobot(folder)
    for key in ("observation.state", "action"):
        mark(folder, key, shape=[1], names=["opening"])
        edit_rows(folder, lambda t, key=key: replaced(t, key, pa.array(STATE[:, 6])))
    dataset = LeRobot(folder)
    assert dataset.names["state"] == ["opening"]
    np.testing.assert_array_equal(dataset.episode(0, ()).state[0], STATE[:, 6:])
    edit_rows(folder, lambda t: replaced(t, "action", pa.array([[1.0, 2.0]] * 25)))
    with pytest.raises(ValueError, match="action of episode 0: its rows have 2 values, not 1"):
        dataset = LeRobot(folder).episode(0, ())


def test_maps_of_names(folder):
    for names in (
        {"motors": [*JOINTS, "gripper"]},
        {"arm": JOINTS, "hand": ["gripper"]},
        {name: index for index, name in reversed([*enumerate([*JOINTS, "gripper"])])},
        [[*JOINTS, "gripper"]],
    ):
        name(folder, names)
        assert LeRobot(folder).names["state"] == [*JOINTS, "gripper"]
    for names in (None, ["state"], [None] * 7, {"motors": None}):
        name(folder, names)
        assert LeRobot(folder).names["state"] == [*"0123456"]
    arm = ["a", "b", "gripper"]
    for key in ("observation.state", "action"):
        mark(folder, key, shape=[6], names={"left": arm, "right": arm})
    assert LeRobot(folder).names["action"][2:5] == ["left.gripper", "right.a", "right.b"]


def test_repeated_names_of_dimensions(folder):
    repeated = ["a", "b", "gripper", "a", "b", "c", "gripper"]
    name(folder, repeated)
    dataset = LeRobot(folder)
    assert dataset.names["state"] == repeated
    np.testing.assert_array_equal(dataset.episode(0, ()).state[0], STATE)
    with pytest.raises(ValueError, match="state has several gripper, dimensions 2, 6"):
        LeRobot(folder, Keys(state_numbers=("c", "gripper")))
    chosen = ("3", "c", "6")
    found = LeRobot(folder, Keys(state_numbers=chosen, action_numbers=chosen)).episode(0, ())
    np.testing.assert_array_equal(found.state[0], STATE[:, [3, 5, 6]])


def test_names_that_are_numbers_are_no_order(folder):
    name(folder, [*"6543210"])
    np.testing.assert_array_equal(LeRobot(folder).episode(0, ()).state[0], STATE)
    with pytest.raises(ValueError, match="several 6, dimensions 0, 6"):
        LeRobot(folder, Keys(state_numbers=("6",)))


def test_state_and_action_in_another_order(folder):
    mark(folder, "action", names=["gripper", *JOINTS])
    with pytest.raises(ValueError, match="one order with --state-numbers"):
        LeRobot(folder)
    LeRobot(folder, Keys(action_numbers=(*JOINTS, "gripper")))


def test_both_grippers_of_two_arms_have_the_units_of_grippers(folder):
    name(folder, ["a", "b", "left", "c", "d", "e", "right"])
    keys = Keys(grippers=("left", "right"), angles="degrees", gripper="millimetres")
    found = LeRobot(folder, keys).episode(0, ()).state[0]
    unit = np.full(7, np.deg2rad(1))
    unit[[2, 6]] = 1e-3
    np.testing.assert_allclose(found, STATE * unit, rtol=1e-6)
    with pytest.raises(ValueError, match="selected state has no thumb"):
        LeRobot(folder, Keys(grippers=("thumb",)))


def test_cameras_of_the_same_short_name(folder):
    def repeat(info):
        info["features"]["side"] = info["features"][SIDE] | {"dtype": "image"}

    edit_info(folder, repeat)
    assert LeRobot(folder).cameras == {key: key for key in (SIDE, WRIST, "side")}
    mark(folder, "side", dtype="none")
    edit_info(folder, lambda info: info["features"].update({"left:eye": info["features"][SIDE]}))
    with pytest.raises(ValueError, match="convert --cameras NAME=left:eye"):
        LeRobot(folder)
    assert main(["inspect", str(folder), "--cameras", f"a={SIDE}", f"a={WRIST}"]) == 2


@pytest.mark.parametrize("text", ["\u2028", "\u2029", "\u0085", "\x0b", "\r"])
def test_line_ends_of_unicode_in_an_instruction(text, folder):
    path = folder / "meta" / "tasks.jsonl"
    tasks = [{"task_index": i, "task": f"press{text}{i}"} for i in range(2)]
    lines = [json.dumps(task, ensure_ascii=False) for task in tasks]
    path.write_bytes("\r\n".join(lines).encode())
    assert LeRobot(folder).episode(0, ()).instructions == (f"press{text}0", f"press{text}1")


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize(
    ("tasks", "words"),
    [([None, "press"], "task 0 must be text, got None"), (["a", "b", "c"], "task 1 is both 'b'")],
)
def test_tasks_are_unique_texts(tasks, words, version, tmp_path):
    folder = copied(version, tmp_path)
    rows = [{"task_index": min(i, 1), "task": text} for i, text in enumerate(tasks)]
    if version == "v3":
        pq.write_table(pa.Table.from_pylist(rows), folder / "meta" / "tasks.parquet")
    else:
        (folder / "meta" / "tasks.jsonl").write_text("\n".join(map(json.dumps, rows)))
    with pytest.raises(ValueError, match=words):
        LeRobot(folder)


def test_tasks_and_times_of_an_episode(folder):
    def change(name, values):
        edit_rows(folder, lambda table: replaced(table, name, pa.array(values)))

    for tasks in ([0] * 24 + [1], [7] * 25):
        change("task_index", tasks)
        with pytest.raises(ValueError, match=r"episode 0 must have one of the tasks \[0, 1\], got"):
            LeRobot(folder).episode(0, ())
    change("timestamp", 2.5 + np.arange(25) / 10)
    with pytest.raises(ValueError, match=r"episode 0 begins at the timestamp 2\.5 s, but"):
        LeRobot(folder).episode(0, ())


def test_repeated_columns(folder):
    edit_rows(folder, lambda table: table.append_column("action", table["action"]))
    with pytest.raises(ValueError, match="several columns action"):
        LeRobot(folder).episode(0)


def test_grippers_are_found_by_name():
    """Or else the last dimension is one."""
    find = lerobot_features.grippers
    assert find(["left_joint", "left_Gripper.pos", "right_joint", "right_gripper"]) == [1, 3]
    assert find(["0", "1", "2"]) == [2]
