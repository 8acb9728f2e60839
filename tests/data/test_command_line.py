"""`python -m lorasp_jax.data`, called in this process."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import tensorflow_datasets as tfds
from PIL import Image

from envs.datasets import rlds
from envs.datasets.episodes import full_name, labelled
from lorasp_jax.data import inspection, rlds_export
from lorasp_jax.data.__main__ import main
from lorasp_jax.data.cache import Cache
from lorasp_jax.data.keys import Keys
from lorasp_jax.data.lerobot import LeRobot
from lorasp_jax.data.opening import open_source
from tests.data.lerobots import VERSIONS, copied, cut, digest, golden
from tests.envs.datasets.test_episodes import assert_equal


def run(capsys, *arguments):
    code = main([str(argument) for argument in arguments])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_inspect(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    before = digest(golden("v3"))
    code, out, _ = run(capsys, "inspect", golden("v3"))
    assert code == 0
    for text in (
        "LeRobot v3.0",
        "side 128 x 96, wrist 128 x 96",
        "4, 25 to 40 steps each",
        "126 at 10 Hz",
        "2  press the green button",
        "state[0] joint_1",
        "action[6] gripper",
    ):
        assert text in out
    (sheet,) = tmp_path.rglob("*.png")
    assert f"contact sheet: {sheet}" in out
    with Image.open(sheet) as picture:
        assert picture.size[1] > 100
    sheet.write_bytes(b"")
    for folder in (golden("v3"), golden("v21"), Path(os.path.relpath(golden("v3")))):
        assert run(capsys, "inspect", folder)[0] == 0  # again, and a dataset of the same name
    assert len(list(tmp_path.rglob("*.png"))) == 2
    assert sheet.stat().st_size > 1000
    assert [path.name for path in tmp_path.iterdir()] == ["cache"]
    assert digest(golden("v3")) == before


def test_output_of_the_contact_sheet(capsys, tmp_path):
    """A user's file is replaced only with --overwrite."""
    out = tmp_path / "new" / "sheet.png"
    assert run(capsys, "inspect", golden("v3"), "--out", out)[0] == 0
    code, text, err = run(capsys, "inspect", golden("v3"), "--out", out)
    assert (code, text, "sheet.png already exists: add --overwrite" in err) == (2, "", True)
    assert run(capsys, "inspect", golden("v3"), "--out", out, "--overwrite")[0] == 0


def test_convert_between_all_formats(capsys, tmp_path):
    made, again, third = tmp_path / "cache", tmp_path / "rlds", tmp_path / "third"
    assert run(capsys, "convert", golden("v3"), "--out", made)[0] == 0
    code, _, err = run(capsys, "convert", made, "--to", "rlds", "--out", again)
    assert code == 0
    assert "126/126" in err
    assert run(capsys, "convert", again, "--out", third)[0] == 0
    dataset = LeRobot(golden("v3"))
    for folder in (made, again, third):
        source = open_source(folder)
        for number in range(4):
            wanted = dataset.episode(number)
            wanted = wanted if folder == made else labelled(wanted, ["success"])  # RLDS has it
            wanted = labelled(wanted) if folder == again else wanted
            assert_equal(source.episode(number), wanted)
    info = json.loads((again / "dataset_info.json").read_text())
    assert info["description"] == "Recorded episodes of dataset by piper."


@pytest.mark.parametrize(("to", "loses"), [("rlds", False), ("lerobot", True), ("cache", False)])
def test_grippers_that_a_format_loses_are_named(to, loses, capsys, tmp_path):
    arguments = ["convert", golden("v3"), "--to", to, "--out", tmp_path / "out"]
    code, text, _ = run(capsys, *arguments, "--grippers", "0")
    assert code == 0
    assert ("grippers are dimensions [0]" in text) == loses


def test_rlds_in_several_files(tmp_path, monkeypatch):
    monkeypatch.setattr(rlds_export, "EPISODES_PER_FILE", 3)
    reports = []
    report = lambda *done: reports.append(done)  # noqa: E731
    rlds_export.to_rlds(LeRobot(golden("v21")), tmp_path / "rlds", report)
    assert [done for done, _ in reports] == [25, 58, 98, 126]
    found = rlds.read(tmp_path / "rlds")
    assert found.length.tolist() == [25, 33, 40, 28]
    assert len(list((tmp_path / "rlds").glob("*array_record*"))) == 2


def test_rlds_keeps_names_and_grippers(tmp_path):
    source = LeRobot(golden("v21"), Keys(grippers=("joint_2",)))
    source.names["action"] = [f"target of {name}" for name in source.names["action"]]
    rlds_export.to_rlds(source, tmp_path / "rlds", lambda *_: None)
    found = open_source(tmp_path / "rlds")
    assert found.names == source.names
    assert found.grippers == {"state": [1], "action": [1]}
    form = tfds.builder_from_directory(tmp_path / "rlds").info.features["steps"]
    assert form["observation"]["state"].doc.desc == ", ".join(source.names["state"])
    assert form["action"].doc.desc == ", ".join(source.names["action"])
    header = json.loads((tmp_path / "rlds/metadata.json").read_text())
    for key, wrong in (("action_names", ["a"]), ("grippers", {"state": [6], "action": [7]})):
        damaged = header | {"options": header["options"] | {key: wrong}}
        (tmp_path / "rlds/metadata.json").write_text(json.dumps(damaged))
        with pytest.raises(ValueError, match=f"options.{key.removeprefix('action_')}"):
            open_source(tmp_path / "rlds")


def test_two_datasets_in_one_cache(capsys, tmp_path):
    out = tmp_path / "both"
    options = ["--cameras", "main=observation.images.side", "--every", "2", "--image-size", "64"]
    code, out_text, _ = run(capsys, "convert", golden("v3"), golden("v21"), "--out", out, *options)
    assert (code, "8 episodes" in out_text) == (0, True)
    found = Cache(out)
    assert (len(found), found.control_dt, found.cameras) == (8, 0.2, {"main": [48, 64]})
    half = len(found.steps.end) // 2
    np.testing.assert_array_equal(found.steps.action[:half], found.steps.action[half:])
    assert len(found.instructions) == 2


@pytest.mark.parametrize("to", ["cache", "rlds", "lerobot"])
def test_a_truncated_video(to, capsys, tmp_path):
    folder = copied("v21", tmp_path)
    cut(folder / "videos", "*1.mp4", 0.5)
    before = digest(folder)
    code, _, err = run(capsys, "convert", folder, "--to", to, "--out", tmp_path / "made")
    assert code == 2
    assert "error: " in err
    assert "000001.mp4" in err.replace("\n", "")
    assert digest(folder) == before
    assert [path.name for path in tmp_path.iterdir()] == ["dataset"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["inspect", "nothing"], "nothing"),
        *[(["convert", *map(golden, VERSIONS), "--to", to], "got 2") for to in ("rlds", "lerobot")],
        (["convert", golden("v3"), "--every", "0"], "every"),
        (["convert", golden("v3"), "--state-numbers", "0", "9"], "state has no 9"),
    ],
)
def test_bad_input(arguments, sentence, capsys, tmp_path):
    code, _, err = run(capsys, *arguments, "--out", tmp_path / "new.png")
    assert code == 2
    assert sentence in err.replace("\n", " ")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["inspect", "convert"])
def test_output_must_be_local(command, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, err = run(capsys, command, golden("v3"), "--out", "gs://bucket/folder")
    assert code == 2
    assert "cannot write to the URL gs:/bucket/folder: give a path on this machine" in err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("to", ["cache", "rlds", "lerobot"])
def test_a_refused_conversion_leaves_nothing(to, capsys, tmp_path, monkeypatch):
    """No parent folder of the output is created, and no progress bar is shown."""

    def refuse(self, number, cameras=None):
        raise ValueError("no")

    monkeypatch.setattr(LeRobot, "episode", refuse)
    out = tmp_path / "a" / "b" / "made"
    code, text, err = run(capsys, "convert", golden("v3"), "--to", to, "--out", out)
    assert (code, text, err) == (2, "", "error: no\n")
    assert not list(tmp_path.iterdir())


def test_an_interrupt_leaves_nothing(capsys, tmp_path, monkeypatch):
    def stop(self, number, cameras=None):
        raise KeyboardInterrupt

    monkeypatch.setattr(LeRobot, "episode", stop)
    assert run(capsys, "convert", golden("v3"), "--out", tmp_path / "cache")[0] == 130
    assert not list(tmp_path.iterdir())
    with pytest.raises(SystemExit):
        main(["convert", "x", "--out", "y", "--cameras", "side="])


def test_cameras_go_by_the_last_part_of_their_names(capsys, tmp_path):
    """Or by their full names, where they are known by the last part."""
    for text in ("wrist", "images.wrist", "main=wrist"):
        out = tmp_path / text
        options = ["--cameras", text, "--image-size", "64"]
        assert run(capsys, "convert", golden("v3"), "--out", out, *options)[0] == 0
        assert [*Cache(out).cameras] == ["main" if "=" in text else "wrist"]
    assert [*open_source(golden("v3"), cameras=["observation.images.side"]).cameras] == ["side"]
    assert full_name("eye", ["left.eye", "right.eye"]) == "eye"  # not one of them
    assert full_name("eye", ["left.eye", "eye"]) == "eye"
    assert full_name("ye", ["left.eye"]) == "ye"
    code, _, err = run(capsys, "inspect", golden("v3"), "--cameras", "eye")
    assert code == 2
    assert "observation.images.side, observation.images.wrist" in err


def test_long_instructions_give_a_hint(capsys):
    _, out, _ = run(capsys, "inspect", golden("v3"))
    assert "'pick up the red cube and place it in the basket' has 11 tokens" in out
    assert "--model.max-tokens 11" in out
    assert not inspection.prompt_hints(["press the green button"])
