"""Test the judge with an environment of another package's kind: a point on a line, and pictures."""

import contextlib
import dataclasses
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

from lorasp_jax import models
from lorasp_jax.evaluation.intervals import wilson_interval
from lorasp_jax.extras.judge.__main__ import main
from lorasp_jax.extras.judge.actors import RunActor, ServerActor
from lorasp_jax.extras.judge.judge import judge
from lorasp_jax.extras.judge.parallel import judge_in_processes
from lorasp_jax.extras.judge.task import load_tasks
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import FullFineTuning
from lorasp_jax.training import export
from tests import ROOT
from tests.evaluation.line_world import TASK, Line, tasks
from tests.evaluation.policy_servers import policy_server
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, make_run


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


def test_groups_pool_their_episodes():
    results = judge(tasks(), Mover(), 2)
    assert results["episodes"] == 4
    assert list(results["groups"]) == ["easy"]
    assert results["groups"]["easy"]["episodes"] == 2


def test_film_has_a_frame_per_action(tmp_path):
    judge([TASK], Mover(), 1, films=tmp_path / "films")
    with Image.open(tmp_path / "films" / "line.webp") as film:
        assert film.size == (8, 8)


CHANGES = {
    "never reported 'won' in info, which had success": {"success": "won"},
    "the observation has no side: it has pixels, at": {"cameras": {"side": "side"}},
    "must return uint8 pictures [H, W, 3], got float64 [1]": {"cameras": {"side": "at"}},
    "has no speed: it has pixels, at": {"state": "speed"},
    "must have one axis, got shape [8, 8, 3]": {"state": "pixels"},
    "predicts 2: lower the task's replan": {"replan": 3},
    "takes actions of shape [1], but the policy's have shape [2]": {
        "action": lambda action: np.zeros(2)
    },
}


@pytest.mark.parametrize("message", CHANGES)
def test_misfits_are_named(message):
    with pytest.raises(ValueError) as error:  # noqa: PT011
        judge([dataclasses.replace(TASK, **CHANGES[message])], Mover(), 1)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("fields", "message"),
    [({"hold": 0}, "hold of task"), ({"cameras": {}}, "camera"), ({"instruction": ""}, "instruc")],
)
def test_bad_tasks_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(TASK, **fields)


HERE = "tests.evaluation.line_world"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("line", "must be MODULE:factory"),
        ("tests.nowhere:tasks", "there is no module tests.nowhere"),
        (f"{HERE}:nothing", "has no function nothing"),
        (f"{HERE}:not_tasks", "must return a Task"),
    ],
)
def test_bad_factories_are_named(name, message):
    with pytest.raises(ValueError, match=message):
        load_tasks(name)


def test_tasks_are_selected_by_name():
    assert [task.name for task in load_tasks(f"{HERE}:tasks", ["other"])] == ["other"]
    with pytest.raises(ValueError, match="no task third: choose from line, other"):
        load_tasks(f"{HERE}:tasks", ["third"])


def act(request):
    """Act like `Mover`, refusing instructions other than that of `TASK`."""
    if request["prompt"] != TASK.instruction:
        raise ValueError("no such prompt")
    return Mover().act(request["image"], request["state"], request["prompt"])


def test_command_judges_a_server(tmp_path, capsys):
    out = tmp_path / "results.json"
    with policy_server(act) as url:
        options = ["--server", url, "--env", f"{HERE}:tasks", "--episodes", "3", "--out", str(out)]
        assert main(options) == 0
        assert main(options) == 2  # does not overwrite
    printed, errors = capsys.readouterr()
    assert "line   100.0 %" in printed
    assert "exists: choose another --out" in errors
    results = json.loads(out.read_text())
    assert results["tasks"]["other"]["outcomes"] == [True] * 3


def test_processes_judge_as_one_does(tmp_path):
    command = [sys.executable, "-m", "lorasp_jax.extras.judge", "--env", f"{HERE}:tasks"]
    found = {}
    with policy_server(act) as url:
        for count in ("1", "2"):
            out, films = tmp_path / f"{count}.json", tmp_path / f"films{count}"
            options = ["--server", url, "--processes", count, "--out", str(out)]
            options += ["--episodes", "3", "--seed", "4", "--films", str(films)]
            subprocess.run([*command, *options], cwd=ROOT, timeout=120, check=True)
            found[count] = json.loads(out.read_text())
            assert sorted(path.name for path in films.iterdir()) == ["line.webp", "other.webp"]
    for key in ("tasks", "groups", "steps"):
        assert found["1"][key] == found["2"][key]


def test_processes_end_with_the_judge(tmp_path):
    """A killed judge must leave no process behind."""

    def wait(_request):
        (tmp_path / "asked").touch()
        time.sleep(3)
        return np.zeros((2, 1), np.float32)

    command = [sys.executable, "-m", "lorasp_jax.extras.judge", "--env", f"{HERE}:tasks"]
    with policy_server(wait) as url:
        judging = subprocess.Popen([*command, "--server", url, "--processes", "2"], cwd=ROOT)
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


def test_a_killed_process_is_named():
    with pytest.raises(ValueError, match="a process that judged a task was killed"):
        judge_in_processes(f"{HERE}:tasks", (), die, 1, 2)


def test_an_error_in_a_process_is_one_sentence(tmp_path, capsys):
    def refuse(request):
        raise ValueError("no such prompt")

    options = ["--env", f"{HERE}:tasks", "--processes", "2"]
    with policy_server(refuse) as url:
        assert main(["--server", url, *options]) == 2
    assert capsys.readouterr().err == "error: the policy server refused: no such prompt\n"
    assert main(["--server", url, *options]) == 2
    assert capsys.readouterr().err.startswith("error: no policy server at")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--server", "ws://127.0.0.1:9", "--processes", "0"], "must be at least 1, got 0"),
        (["runs/x", "--processes", "2"], "--processes needs --server"),
    ],
)
def test_bad_numbers_of_processes_are_refused(arguments, message, capsys):
    assert main([*arguments, "--env", f"{HERE}:tasks"]) == 2
    assert message in capsys.readouterr().err


def test_server_refusals_are_one_sentence():
    task = dataclasses.replace(TASK, instruction="fly")
    with (
        policy_server(act) as url,
        contextlib.closing(ServerActor(url)) as actor,
        pytest.raises(ValueError, match="refused: no such prompt"),
    ):
        judge([task], actor, 1)


@pytest.mark.parametrize("arguments", [[], ["runs/x", "--server", "ws://127.0.0.1:9"]])
def test_one_policy_is_required(arguments, capsys):
    assert main([*arguments, "--env", f"{HERE}:tasks"]) == 2
    assert "either the folder of a run or --server" in capsys.readouterr().err


def test_client_needs_no_jax():
    program = (
        "import sys; sys.modules.update(dict.fromkeys(['jax', 'mujoco', 'flax', 'envs']))\n"
        "import lorasp_jax.extras.serving.client\n"
        "from lorasp_jax.extras.judge.__main__ import main\n"
        "sys.exit(main(['--server', 'ws://127.0.0.1:9', '--env', 'nowhere:tasks']))"
    )
    command = [sys.executable, "-c", program]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert process.returncode == 2
    assert process.stderr.startswith("error: there is no module nowhere")


def test_run_without_jax_names_the_way_out(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", None)
    with pytest.raises(ValueError, match=r"needs jax, .* give --server"):
        RunActor(Path("runs/x"), ["go"])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Write a finished run of a robot with six joints and a gripper."""
    folder = tmp_path_factory.mktemp("runs")
    models.save(folder / "base", random_backbone(Pi0Config.dummy()))
    model = dataclasses.replace(CONFIG.model, checkpoint=str(folder / "base"))
    config = dataclasses.replace(CONFIG, model=model, peft=FullFineTuning())
    run = make_run(folder / "run", config, models.load(folder / "base"))
    run.base_hash = models.weights_hash(folder / "base")
    export.write(run)
    return run


def test_run_acts_as_its_policy(run):
    actor = RunActor(run.folder, ["push the button", "push button"])
    rng = np.random.default_rng(0)
    images = {name: rng.integers(0, 255, (32, 32, 3), np.uint8) for name in ("side", "wrist")}
    state = rng.normal(size=7).astype(np.float32)
    actor.reset(4)
    chunk = actor.act(images, state, "push the button")
    observation = {"image": {k: v[None] for k, v in images.items()}, "state": state[None]}
    key = jax.random.split(jax.random.key(4))[1]
    row = run.policy.processor.prompts.rows(["push the button"])
    (expected,) = run.policy.sample(key, observation, row)
    np.testing.assert_allclose(chunk, expected, rtol=1e-4, atol=1e-5)
    actor.reset(4)
    assert np.abs(actor.act(images, state, "push button") - chunk).max() > 1e-6
    with pytest.raises(ValueError, match="camera wrist"):
        actor.act({"side": images["side"]}, state, "push the button")
    with pytest.raises(ValueError, match="7"):
        actor.act(images, state[:4], "push the button")
