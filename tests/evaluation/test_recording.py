"""A policy's own episodes become a labelled dataset."""

import dataclasses
import re
from types import SimpleNamespace
from typing import ClassVar
from unittest.mock import Mock, patch

import jax
import numpy as np
import pytest

from lorasp_jax.config import EvaluationConfig
from lorasp_jax.data.opening import open_source
from lorasp_jax.evaluation import __main__ as command
from lorasp_jax.evaluation import recording
from lorasp_jax.evaluation.programs import make_rollout
from tests.evaluation.test_programs import KEY, ROOMS, Room, policy
from tests.runs import CONFIG


@dataclasses.dataclass(frozen=True, eq=False)
class Lab(Room):
    """A room with what an environment says of itself."""

    task: ClassVar = SimpleNamespace(name="press")
    robot: ClassVar = SimpleNamespace(name="piper")
    control_dt: ClassVar = 0.1
    physics_dt: ClassVar = 0.005
    actions: ClassVar = "joint"
    action_low: ClassVar = np.full(7, -1.5, np.float32)
    action_high: ClassVar = np.full(7, 1.5, np.float32)


LAB = Lab(ROOMS[0].instructions, ROOMS[0].max_steps)


def test_episodes_are_those_of_an_evaluation():
    """Each with its outcome, up to its end, and with pictures and states before each action."""
    found = recording.record(policy(), LAB, KEY, execute_steps=3, denoise_steps=2)
    wanted = make_rollout(LAB, execute_steps=3, denoise_steps=2)(policy(), KEY)
    found.validate()
    np.testing.assert_array_equal(found.success == 1, wanted.success)
    assert set(found.success) == {0, 1}
    # A success ends a step earlier in a room's count than in the recording.
    np.testing.assert_array_equal(found.length, np.where(wanted.success, wanted.steps + 1, 6))
    moved = found.state[:, 1:, 0] - found.state[:, :-1, 0]
    world = int(np.argmax(found.length))
    executed = found.action[world, : found.length[world] - 1, 0]
    free = np.abs(executed) < 1.5  # the limits of what was executed
    assert free.any()
    steps = moved[world, : len(executed)]
    np.testing.assert_allclose(steps[free], 0.1 * executed[free], atol=1e-5)
    assert np.abs(found.action).max() == pytest.approx(1.5)
    short = int(np.argmin(found.length))
    assert not found.image["side"][short, found.length[short] :].any()


def config(**changes):
    evaluation = EvaluationConfig(num_envs=16, episodes=16, execute_steps=3, denoise_steps=2)
    return dataclasses.replace(CONFIG, tasks=("press",), evaluation=evaluation, **changes)


def test_a_dataset_has_as_many_as_wanted(tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "environment", lambda *_: LAB)
    done, folder = [], tmp_path / "press"
    arguments = policy(), config(), "press", folder, 20
    wins = recording.write(*arguments, seed=1, progress=done.append)
    assert done == [16, 4]
    source = open_source(folder)
    outcomes = [int(source.episode(number, ()).success[0]) for number in range(len(source))]
    assert (len(outcomes), sum(outcomes)) == (20, wins)
    with pytest.raises(ValueError, match="exists"):
        recording.write(*arguments, seed=2, progress=done.append)


def test_the_command_says_how_many_succeeded(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(recording, "environment", lambda *_: LAB)
    monkeypatch.setattr("lorasp_jax.training.finished_run.recorded_config", lambda _: config())
    load = Mock(return_value=policy())
    monkeypatch.setattr("lorasp_jax.training.export.load_policy", load)
    words = [str(tmp_path / "run"), "--record", str(tmp_path / "tries"), "--rollouts", "5"]
    with patch.object(recording, "record", wraps=recording.record) as record:
        assert command.main([*words, "--dataset", "mugs", "--denoise-steps", "3"]) == 0
    assert f"{tmp_path}/tries/press:" in capsys.readouterr().out
    load.assert_called_once_with(tmp_path / "run", dataset="mugs")
    assert record.call_args.kwargs["denoise_steps"] == 3


def test_no_task_is_recorded_if_one_of_the_folders_exists(tmp_path, monkeypatch, capsys):
    tasks = dataclasses.replace(config(), tasks=("pour", "press"))
    monkeypatch.setattr("lorasp_jax.training.finished_run.recorded_config", lambda _: tasks)
    load = Mock()
    monkeypatch.setattr("lorasp_jax.training.export.load_policy", load)
    (tmp_path / "press").mkdir()
    assert command.main(["run", "--record", str(tmp_path)]) == 2
    assert "press already exists" in " ".join(capsys.readouterr().err.split())
    assert not load.called


@pytest.mark.parametrize(
    "words",
    [
        ["--record", "tries", "--data", "both"],
        ["--record", "tries", "--episodes", "1"],
        ["--record", "tries", "--out", "pictures"],
        ["--record", "tries", "--angles", "degrees"],
        ["--record", "tries", "--image-size", "0"],
        ["--data", "mugs", "--rollouts", "5"],
        ["--data", "mugs", "--seed", "1"],
        ["--record", "tries", "--seed", "-1"],
    ],
)
def test_options_that_would_not_count_are_refused(words, capsys):
    with pytest.raises(SystemExit):
        command.main(["run", *words])
    assert re.search(f"{words[2]}: (not allowed with|must be)", capsys.readouterr().err)


def test_other_seeds_give_other_episodes():
    keys, settings = jax.random.split(KEY, 2), {"execute_steps": 3, "denoise_steps": 2}
    first, second = (recording.record(policy(), LAB, key, **settings).state for key in keys)
    assert first.shape != second.shape or np.abs(first - second).max() > 0.1
