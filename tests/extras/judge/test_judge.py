"""Test the judge with an environment of another package's kind: a point on a line, and pictures."""

import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lorasp_jax.base.intervals import wilson_interval
from lorasp_jax.extras.judge.__main__ import main, table
from lorasp_jax.extras.judge.actors import RunActor
from lorasp_jax.extras.judge.judge import judge
from lorasp_jax.extras.judge.parallel import judge_in_processes
from lorasp_jax.extras.judge.task import load_tasks
from lorasp_jax.training.run_folder import to_json, write_json
from tests import ROOT
from tests.cases import mostly_slow
from tests.evaluation.line_world import TASK, Line, tasks
from tests.evaluation.policy_servers import policy_server
from tests.extras.serving.test_policies import STEPS, noise_of, reference, request
from tests.runs import CONFIG


class Mover:
    """Moves towards the goal, or always to the right; remembers what it saw."""

    def __init__(self, homes=True, size=1, chunk=2):
        self.homes, self.size, self.chunk, self.seen, self.seeds = homes, size, chunk, [], []

    def reset(self, seed):
        self.seeds.append(seed)

    def act(self, images, state, instruction):
        self.seen.append((images, state, instruction))
        value = -np.sign(state[0]) if self.homes else 1.0
        return np.full((self.chunk, self.size), value, np.float32)


def test_success_is_the_environments():
    results = judge([TASK], Mover(), 6)
    assert results["success"] == 1.0
    assert results["ci95"] == list(wilson_interval(6, 6))
    assert 9 <= results["steps"] <= 20
    wins = judge([TASK], Mover(homes=False), 20, seed=5)["tasks"]["line"]["outcomes"]
    starts = [Line().reset(seed=5 + i)[0]["at"][0] for i in range(20)]
    assert wins == [start < 0 for start in starts]
    assert 0 < sum(wins) < 20


def test_policy_sees_the_mapped_observation():
    mover = Mover()
    task = dataclasses.replace(
        TASK,
        cameras={"top": lambda env: np.zeros((4, 6, 3), np.uint8)},
        state=lambda observation: np.array([observation["at"][0], 7]),
    )
    judge([task], mover, 2, seed=3)
    images, state, instruction = mover.seen[0]
    assert images["top"].shape == (4, 6, 3)
    assert state.dtype == np.float32
    assert state[1] == 7
    assert instruction == "go to zero"
    assert mover.seeds == [3, 4]


def test_hold_and_replan_count_environment_steps():
    mover = Mover(homes=False)
    task = dataclasses.replace(TASK, hold=3, max_steps=9, action=lambda a: 0 * a)
    assert judge([task], mover, 1)["steps"] == 9
    assert len(mover.seen) == 2  # looks at steps 0 and 6


def test_groups_pool_their_episodes_and_films_have_a_frame_per_action(tmp_path):
    results = judge(tasks(), Mover(), 2, films=tmp_path / "films")
    assert results["episodes"] == 4
    assert {name: group["episodes"] for name, group in results["groups"].items()} == {"easy": 2}
    with Image.open(tmp_path / "films" / "line.webp") as film:
        assert film.size == (8, 8)


def test_the_table_shows_a_task_and_a_group_of_one_name():
    both = [dataclasses.replace(each, group="line") for each in tasks()]
    lines = [line.split() for line in table(judge(both, Mover(), 2)).splitlines()]
    assert [(line[0], line[-1]) for line in lines[:4]] == [
        *(("line", "2"), ("other", "2"), ("line", "4"), ("all", "4")),
    ]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"success": "won"}, "never reported 'won' in info, which had success"),
        ({"cameras": {"side": "side"}}, "no side: it has pixels, at"),
        ({"cameras": {"side": "at"}}, r"uint8 pictures \[H, W, 3\], got float64 \[1\]"),
        ({"state": "speed"}, "no speed: it has pixels, at"),
        ({"state": "pixels"}, r"one axis, got shape \[8, 8, 3\]"),
        ({"replan": 3}, "predicts 2: lower the task's replan"),
        ({"action": lambda action: np.zeros(2)}, r"shape \[1\], but .* shape \[2\]"),
        ({"hold": 0}, "hold of task"),
        ({"cameras": {}}, "camera"),
        ({"instruction": ""}, "instruction"),
    ],
)
def test_misfits_are_named(fields, message):
    with pytest.raises(ValueError, match=message):
        judge([dataclasses.replace(TASK, **fields)], Mover(), 1)


HERE = "tests.evaluation.line_world"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("line", "must be MODULE:factory"),
        ("tests.nowhere:tasks", "no module tests.nowhere"),
        (f"{HERE}:nothing", "no function nothing"),
        (f"{HERE}:not_tasks", "must return a GymTask"),
        (f"{HERE}:tasks", "no task third: choose from line, other"),
    ],
)
def test_tasks_are_selected_by_name(name, message):
    assert [task.name for task in load_tasks(f"{HERE}:tasks", ["other"])] == ["other"]
    with pytest.raises(ValueError, match=message):
        load_tasks(name, ["third"])


def act(request):
    """Act like `Mover`, refusing instructions other than that of `TASK`."""
    if request["prompt"] != TASK.instruction:
        raise ValueError("no such prompt")
    return Mover().act(request["image"], request["state"], request["prompt"])


COMMAND = [sys.executable, "-m", "lorasp_jax.extras.judge", "--env", f"{HERE}:tasks"]


def test_processes_judge_as_one_does(tmp_path, capsys):
    found = {}
    with policy_server(act) as url:
        for count in ("1", "2"):
            out, films = tmp_path / "new" / f"{count}.json", tmp_path / f"films{count}"
            options = ["--server", url, "--processes", count, "--out", str(out)]
            options += ["--episodes", "3", "--seed", "4", "--films", str(films)]
            assert main([*COMMAND[3:], *options]) == 0
            found[count] = json.loads(out.read_text())
            assert sorted(path.name for path in films.iterdir()) == ["line.webp", "other.webp"]
        assert main([*COMMAND[3:], *options]) == 2  # does not overwrite
    printed, errors = capsys.readouterr()
    assert printed.count("line   100.0 %") == 2
    assert "exists: choose another --out" in errors
    for key in ("tasks", "groups", "steps"):
        assert found["1"][key] == found["2"][key]
    assert found["1"]["tasks"]["other"]["outcomes"] == [True] * 3


@pytest.mark.slow
def test_processes_end_with_the_judge(tmp_path):
    """A killed judge must leave no process behind."""

    def wait(_request):
        (tmp_path / "asked").touch()
        time.sleep(3)
        return np.zeros((2, 1), np.float32)

    with policy_server(wait) as url:
        judging = subprocess.Popen([*COMMAND, "--server", url, "--processes", "2"], cwd=ROOT)
        while not (tmp_path / "asked").exists():
            time.sleep(0.1)
        children = Path(f"/proc/{judging.pid}/task/{judging.pid}/children").read_text().split()
        judging.kill()
        judging.wait()
        deadline = time.monotonic() + 20
        while any(map(_runs, children)) and time.monotonic() < deadline:
            time.sleep(0.2)
    assert len(children) >= 2
    assert not any(map(_runs, children))


def _runs(pid):
    """Say whether a process is there and no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def die():
    os._exit(1)


@pytest.mark.slow
def test_a_killed_process_is_named():
    with pytest.raises(ValueError, match="a process that judged a task was killed"):
        judge_in_processes(f"{HERE}:tasks", (), die, 1, 2)


@pytest.mark.parametrize("processes", mostly_slow(["1", "2"], ["1"]))
def test_an_error_of_the_server_is_one_sentence(processes, capsys):
    def refuse(request):
        raise ValueError("no such prompt")

    options = ["--env", f"{HERE}:tasks", "--processes", processes]
    with policy_server(refuse) as url:
        assert main(["--server", url, *options]) == 2
    assert capsys.readouterr().err == "error: the policy server refused: no such prompt\n"
    assert main(["--server", url, *options]) == 2
    assert capsys.readouterr().err.startswith("error: no policy server at")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["runs/x", "--processes", "2"], "--processes needs --server"),
        ([], "either the folder of a run or --server"),
        (["runs/x", "--server", "ws://127.0.0.1:9"], "either the folder of a run or --server"),
    ],
)
def test_options_that_do_not_fit_are_refused(arguments, message, capsys):
    assert main([*arguments, "--env", f"{HERE}:tasks"]) == 2
    assert message in capsys.readouterr().err


def test_only_a_run_needs_jax():
    program = (
        "import sys\n"
        "sys.modules.update(dict.fromkeys(['jax', 'mujoco', 'flax', 'envs', 'rich']))\n"
        "from lorasp_jax.extras.judge.__main__ import main\n"
        f"for policy in (['--server', 'ws://127.0.0.1:9'], ['runs/x']):\n"
        f"    assert main([*policy, '--env', '{HERE}:tasks']) == 2"
    )
    command = [sys.executable, "-c", program]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    server, run = process.stderr.splitlines()
    assert server.startswith("error: no policy server at")
    assert re.fullmatch(r"error: runs/x needs jax.* give --server", run)


def test_run_acts_as_its_policy(finished, tmp_path):
    """In the flow steps of its evaluation, with a server's noise, here of the fifth connection."""
    evaluation = dataclasses.replace(CONFIG.evaluation, denoise_steps=STEPS)
    config = dataclasses.replace(CONFIG, evaluation=evaluation)
    folder = shutil.copytree(finished.folder, tmp_path / "run")
    write_json(folder / "config.json", to_json(config))
    actor = RunActor(folder, ["push the button", "push button"])
    sent = request(actor._policy.spec, prompt="push the button")
    images, state = sent.images, sent.state
    actor.reset(4)
    chunk = actor.act(images, state, "push the button")
    noise = noise_of(actor._policy.spec, connection=4)
    np.testing.assert_allclose(chunk, reference(finished.policy, [sent], noise)[0], atol=1e-5)
    assert np.abs(actor.act(images, state, "push the button") - chunk).max() > 1e-6
    actor.reset(2**31 + 4)  # seeds have 32 bits, the noise's numbers 31
    assert np.abs(actor.act(images, state, "push button") - chunk).max() > 1e-6
    with pytest.raises(ValueError, match="camera wrist"):
        actor.act({"side": images["side"]}, state, "push the button")
    with pytest.raises(ValueError, match="7"):
        actor.act(images, state[:4], "push the button")
