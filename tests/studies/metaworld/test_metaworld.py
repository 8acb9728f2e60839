"""Test the Meta-World example without Meta-World: its tasks, and that its datasets can be read."""

import importlib
import json
import os
import re
import subprocess
import sys
import venv

import numpy as np
import pytest

from lorasp_jax.data import open_source
from lorasp_jax.extras.judge.task import load_tasks
from lorasp_jax.policies import tokenizer
from studies.metaworld import dataset
from studies.metaworld.tasks import GROUPS, INSTALL, INSTRUCTIONS
from tests import ROOT
from tests.evaluation.policy_servers import policy_server

MAX_TOKENS = 32
"""As in the page's command."""


def test_groups_are_the_usual_ones():
    assert {name: len(tasks) for name, tasks in GROUPS.items()} == {
        "easy": 28,
        "medium": 11,
        "hard": 6,
        "very hard": 5,
    }
    assert len(INSTRUCTIONS) == len(set(INSTRUCTIONS.values())) == 50


def test_instructions_fit_the_bundled_tokenizer():
    ids, _ = tokenizer.Offline().encode([*INSTRUCTIONS.values()], MAX_TOKENS)
    assert len(np.unique(ids, axis=0)) == 50


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Write two tasks of two and one episodes; return the folder and the episodes."""
    folder = tmp_path_factory.mktemp("data") / "mt"
    rng = np.random.default_rng(0)
    episodes = [
        (
            rng.integers(0, 255, (length, 8, 8, 3), np.uint8),
            rng.normal(size=(length, 4)).astype(np.float32),
            rng.uniform(-1, 1, (length, 4)).astype(np.float32),
        )
        for length in (3, 5, 4)
    ]
    encoded = [([dataset.png(p) for p in pictures], *rest) for pictures, *rest in episodes]
    writer = dataset.Writer(folder, 8)
    writer.add_task("open the drawer", encoded[:2])
    writer.add_task("turn the dial", encoded[2:])
    writer.close()
    return folder, episodes


def test_a_dataset_is_read_as_written(written):
    folder, episodes = written
    source = open_source(folder)
    assert source.kind == "LeRobot v3.0"
    assert source.control_dt == pytest.approx(0.1)
    assert len(source) == 3
    for number, (pictures, state, action) in enumerate(episodes):
        read = source.episode(number)
        np.testing.assert_array_equal(read.image["corner2"][0], pictures)
        np.testing.assert_array_equal(read.state[0], state)
        np.testing.assert_array_equal(read.action[0], action)
        expected = "turn the dial" if number == 2 else "open the drawer"
        assert read.instructions[read.instruction[0]] == expected


def test_a_dataset_is_not_overwritten(written):
    with pytest.raises(FileExistsError):
        dataset.Writer(written[0], 8)


def test_missing_package_names_the_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "metaworld.env_dict", None)
    monkeypatch.delitem(sys.modules, "studies.metaworld.world", raising=False)
    with pytest.raises(ValueError, match=re.escape(INSTALL)):
        load_tasks("studies.metaworld.world:mt50")


def test_recording_without_the_package_names_the_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "metaworld.policies", None)
    for name in ("collect", "expert"):
        monkeypatch.delitem(sys.modules, f"studies.metaworld.{name}", raising=False)
    with pytest.raises(SystemExit, match=re.escape(INSTALL)):
        importlib.import_module("studies.metaworld.collect")


@pytest.mark.slow
def test_unmodified_metaworld_records_and_judges(tmp_path):
    """In an environment of its own, which pins another MuJoCo and has no JAX."""
    venv.create(tmp_path / "venv", with_pip=True)
    python = str(tmp_path / "venv" / "bin" / "python")
    run([python, "-m", "pip", "-q", *INSTALL.split()[1:]])
    data = tmp_path / "data"
    collect = [python, "-m", "studies.metaworld.collect", str(data), "--tasks", "reach"]
    run([*collect, "--episodes", "2", "--processes", "1"])
    source = open_source(data)
    episode = source.episode(1)
    assert len(source) == 2
    assert episode.image["corner2"].shape[2:] == (128, 128, 3)
    assert episode.image["corner2"].std() > 20  # not black
    assert np.abs(episode.action).max() <= 1
    assert "hand" in episode.instructions[0]

    def act(request):
        """Move to the place where the second demonstration ended: the same seed, the same layout.

        Five actions of eight steps of 1 cm cover the distance at a gain of 2.5 / m.
        """
        move = 2.5 * (episode.state[0, -1] - request["state"])
        return np.tile(np.clip(move, -1, 1), (5, 1)).astype(np.float32)

    out = tmp_path / "results.json"
    with policy_server(act) as url:
        judge = [python, "-m", "lorasp_jax.extras.judge", "--server", url, "--tasks", "reach"]
        judge += ["--env", "studies.metaworld.world:mt50", "--episodes", "2", "--out", str(out)]
        run([*judge, "--seed", str(1_000_001)])
    assert json.loads(out.read_text())["tasks"]["reach"]["outcomes"][0] is True


def run(command):
    environment = {**os.environ, "MUJOCO_GL": "egl", "PYTHONPATH": str(ROOT)}
    process = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert process.returncode == 0, process.stderr[-2000:]
