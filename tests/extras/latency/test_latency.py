"""The command: what it measures, its files, and its errors on one line."""

import dataclasses
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from lorasp_jax.base.intervals import wilson_interval
from lorasp_jax.extras.latency import __main__ as command
from lorasp_jax.extras.latency import curve, figure
from lorasp_jax.extras.latency.execution import EXECUTIONS, Trace
from lorasp_jax.extras.study import results, run_cell
from lorasp_jax.training.random_streams import RandomStream
from lorasp_jax.training.run_folder import read_json, to_json, write_json
from tests.runs import CONFIG, RESULTS, finish, write_description

SETTINGS = dataclasses.replace(CONFIG.evaluation, episodes=4, num_envs=2, denoise_steps=3)
TASK = RESULTS["tasks"]["press"]
WRITE = figure.write  # most tests draw none


def played(env, execution, *, denoise_steps, ranges):
    """Stand in for a rollout: the first world succeeds, and targets grow with the delay."""

    def rollout(policy, key, delay):
        assert (ranges, denoise_steps) == (None, 3)
        calls.append((env.task.name, execution.name, execution.execute_steps, delay, key))
        commands = np.zeros((2, 6, 7))
        commands[..., 0] = delay * np.arange(6) ** 3
        return Trace(np.array([True, False]), np.array([6, 6]), commands)

    calls = played.calls
    return rollout


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A finished run on two tasks, with stand-ins for policy and rollouts."""
    (tmp_path / "run").mkdir()
    folder = finish(tmp_path / "run")
    write_json(folder / "results.json", RESULTS | {"tasks": {"press": TASK, "pour": TASK}})
    optim = dataclasses.replace(CONFIG.optim, rtc_max_delay=1)
    config = dataclasses.replace(CONFIG, evaluation=SETTINGS, optim=optim)
    write_json(folder / "config.json", to_json(config))
    write_description(folder)
    policy = SimpleNamespace(with_sampler=lambda: None)
    monkeypatch.setattr(run_cell, "_source", lambda run: policy)
    monkeypatch.setattr(curve, "delayed_rollout", played)
    monkeypatch.setattr(command, "MAX_DELAY", 2)
    monkeypatch.setattr(figure, "write", lambda *_: None)
    monkeypatch.setattr(run_cell.gc, "collect", lambda: 0)  # there are no models
    monkeypatch.setattr(command, "describe", lambda run: {"policy": {"config": {"chunk": 10}}})
    played.calls = []
    return folder


def refused(capsys, *arguments):
    """Return the line on stderr of a command that fails."""
    assert command.main([*map(str, arguments)]) == 2
    printed = capsys.readouterr().err
    assert printed.count("error:") == 1
    return printed


def measured(folder):
    return results.load(folder / "latency/results.json")


def test_every_execution_is_measured_at_every_delay(folder, capsys, monkeypatch):
    monkeypatch.setattr(figure, "write", WRITE)
    assert command.main([str(folder), "--episodes", "4"]) == 0
    beyond, *written = capsys.readouterr().out.splitlines()
    assert beyond.endswith("beyond d = 1 is beyond its --optim.rtc-max-delay")
    assert written == [f"written: {folder / name}" for name in ("latency", "latency.svg")]
    found = measured(folder)
    assert found.keys() == {
        f"{task}/{execution}/d{delay}"
        for task in ("press", "pour")
        for execution in EXECUTIONS
        for delay in range(3)
    }
    point = found["pour/trained/d1"]
    assert (point["outcomes"], point["motion"]["steps"]) == ({"pour": "1010"}, 6)
    assert point["config"]["evaluation"]["execute_steps"] == 5
    np.testing.assert_allclose(found["pour/naive/d2"]["motion"]["action_delta"], 2 * 125 / 5)
    np.testing.assert_allclose(found["pour/naive/d2"]["motion"]["jerk"], 2 * 6 / 0.1**3)
    assert "<svg" in (folder / "latency.svg").read_text()


def test_a_figure_of_several_runs(folder, tmp_path, monkeypatch):
    """The same file every time, whichever executions the first run has."""
    (tmp_path / "other").mkdir()
    other = finish(tmp_path / "other")
    write_json(other / "config.json", read_json(folder / "config.json"))
    write_description(other)
    command.main([str(folder), "--executions", "naive", "--delays", "0", "1", "--tasks", "press"])
    path = tmp_path / "new" / "both.svg"
    options = ["--delays", "0", "1", "--tasks", "press", "--figure", str(path)]
    contents = set()
    monkeypatch.setattr(figure, "write", WRITE)
    for _ in range(2):
        assert command.main([str(folder), str(other), "--executions", "guided", *options]) == 0
        contents.add(path.read_bytes())
    assert len(contents) == 1


def test_the_episodes_are_those_of_the_final_evaluation(folder):
    command.main([str(folder), "--delays", "0", "--tasks", "pour", "--executions", "naive"])
    keys = jax.random.split(RandomStream.FINAL_EVALUATION.key(CONFIG.seed, "pour"), 2)
    assert [call[:4] for call in played.calls] == [("pour", "naive", 5, 0)] * 2
    for call, key in zip(played.calls, keys, strict=True):
        assert (jax.random.key_data(call[4]) == jax.random.key_data(key)).all()


def test_what_is_measured_is_not_measured_again(folder, capsys):
    options = [str(folder), "--tasks", "press", "--executions", "guided"]
    command.main([*options, "--delays", "3"])
    first = len(played.calls)
    command.main([*options, "--delays", "1", "3"])
    assert [call[3] for call in played.calls[first:]] == [1, 1]
    assert measured(folder).keys() == {"press/guided/d1", "press/guided/d3"}
    line = refused(capsys, *options, "--delays", "1", "--guidance", "3")
    assert "it was run with other guidance" in line


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--delays", "6"], "must be from 0 to 5 control steps, got 6"),
        (["--delays", "-1"], "control steps, got -1"),
        (["--tasks", "pres"], "are press, pour, got 'pres'"),
        (["--episodes", "3"], "episodes must be a multiple of num_envs, got 3 and 2"),
        (["--execute-steps", "11"], "from 1 to the chunk length (10), got 11"),
        (["--guidance", "nan"], "--guidance above 0"),
    ],
)
def test_bad_options_are_refused_before_anything_runs(options, reason, folder, capsys):
    assert reason in refused(capsys, folder, *options)
    assert not played.calls


def test_runs_that_cannot_be_measured(folder, capsys):
    write_json(folder / "config.json", to_json(dataclasses.replace(CONFIG, evaluation=SETTINGS)))
    line = refused(capsys, folder, "--executions", "trained")
    assert "was not trained for execution trained: --optim.rtc-max-delay is 0" in line
    command.main([str(folder), "--delays", "0", "--tasks", "press"])
    assert "trained" not in {call[1] for call in played.calls}
    (folder / "results.json").unlink()
    assert "is not a finished run" in refused(capsys, folder)


def test_results_of_a_miscompiled_program_are_refused():
    """Every other episode of a batch succeeds."""
    env = SimpleNamespace(num_envs=128, control_dt=0.1)
    odd = np.arange(128) % 2 == 1
    arguments = (None, env, lambda *_: trace, jax.random.key(0), 256, 0)
    trace = Trace(odd, np.full(128, 4), np.zeros((128, 4, 7)))
    with pytest.raises(ValueError, match="success depends on bit 0 of an episode's index"):
        curve.measure_point(*arguments)
    trace = dataclasses.replace(trace, success=np.ones(128, bool))
    assert curve.measure_point(*arguments)["outcomes"] == 256 * "1"


def test_the_figure_averages_over_tasks():
    """Only delays that all tasks have; the interval pools their episodes."""

    def point(task, delay, outcomes, action_delta, jerk):
        config = {"execution": "naive", "delay": delay}
        motion = {"action_delta": action_delta, "jerk": jerk}
        return {"config": config, "outcomes": {task: outcomes}, "motion": motion}

    points = [point("press", d, "10", 1.0, 4.0) for d in (0, 1)] + [
        point("pour", 1, "11", 3.0, 2.0)
    ]
    found = dict(enumerate(points))
    (mean,) = figure.average(found, "naive")
    assert (mean["delay"], mean["success"], mean["action_delta"], mean["jerk"]) == (1, 75, 2, 3)
    assert mean["ci95"] == [100 * bound for bound in wilson_interval(3, 4)]
    assert figure.average(found, "guided") == figure.average({}, "naive") == []


def test_every_execution_has_a_color():
    assert list(figure.COLORS) == list(EXECUTIONS)
