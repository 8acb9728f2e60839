"""The command `rank-map`: its files, and its errors on one line."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from envs.scene.ranges import Randomization
from lorasp_jax.evaluation import rank_episode, rank_map
from lorasp_jax.evaluation.rank_episode import RankEpisode
from lorasp_jax.report import __main__ as command
from lorasp_jax.training import export
from lorasp_jax.training.run_folder import to_json, write_json
from tests.runs import CONFIG, RESULTS, finish, make_run
from tests.training.test_export import with_random_adapters


@pytest.fixture
def folder(tmp_path):
    return finish(tmp_path)


def refused(capsys, *arguments):
    """Return the line on stderr of a command that fails."""
    assert command.main(["rank-map", *map(str, arguments)]) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    return printed


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"active_rank": {}, "layer_active_rank": {}}, "its vision tower has no active ranks"),
        ({"active_rank": {"action": 3.0}}, "its vision tower has no active ranks"),
        ({"tasks": {}, "active_rank": {}}, "its tasks cannot be simulated"),
    ],
    ids=["full fine-tuning", "action expert only", "not simulated"],
)
def test_runs_without_a_map(changes, reason, folder, capsys):
    write_json(folder / "results.json", RESULTS | changes)
    assert f"cannot film {folder}: {reason}" in refused(capsys, folder)
    assert not [*folder.glob("rank_map_*")]


def test_a_run_without_its_policy_its_results_or_the_task(folder, capsys):
    assert "contains no policy" in refused(capsys, folder)
    line = refused(capsys, folder, "--task", "pres")
    assert f"the tasks of {folder} are press, got 'pres'" in line
    (folder / "results.json").unlink()
    assert "no finished run in" in refused(capsys, folder)


def test_every_task_gets_a_film(folder, capsys, monkeypatch):
    """With stand-ins for the policy, the episodes and the drawing."""
    task = RESULTS["tasks"]["press"]
    write_json(folder / "results.json", RESULTS | {"tasks": {"press": task, "pour": task}})
    config = dataclasses.replace(CONFIG, image_size=48, control_dt=0.2)
    write_json(folder / "config.json", to_json(config))
    frames = np.random.default_rng(0).integers(0, 255, (3, 16, 32, 3), np.uint8)
    recorded, episode = [], RankEpisode("press", True, (), {}, {})
    policy = SimpleNamespace(with_sampler=lambda: None)
    monkeypatch.setattr(rank_map, "load_policy", lambda run: policy)
    monkeypatch.setattr(rank_map, "describe", lambda run: {"robot": "panda"})
    monkeypatch.setattr(rank_map, "record", lambda _, env, __: recorded.append(env) or episode)
    monkeypatch.setattr(rank_map, "render_episode", lambda *_: {})
    monkeypatch.setattr(rank_map.rank_film, "draw", lambda *_, **__: frames)
    assert command.main(["rank-map", str(folder)]) == 0
    films = [folder / f"rank_map_{task}.mp4" for task in ("press", "pour")]
    assert capsys.readouterr().out.splitlines() == [f"rank map: {path}" for path in films]
    assert all(path.stat().st_size for path in films)
    made = [(env.task.name, env.robot.name, env.num_envs) for env in recorded]
    assert made == [("press", "panda", 1), ("pour", "panda", 1)]
    assert {(env.image_size, env.control_dt) for env in recorded} == {(48, 0.2)}
    assert command.main(["rank-map", str(folder), "--task", "pour"]) == 0  # films are replaced
    assert len(recorded) == 3


@pytest.mark.slow
def test_a_run_is_filmed(folder, monkeypatch):
    """From an exported policy to the files; only the base, which is random, is not loaded."""
    run = make_run(folder)
    run.policy = with_random_adapters(run.policy)
    export.write(run)
    settings = dataclasses.replace(CONFIG.evaluation, denoise_steps=1)
    scene = Randomization.typical()
    config = dataclasses.replace(CONFIG, evaluation=settings, scene=scene)
    write_json(folder / "config.json", to_json(config))
    monkeypatch.setattr(rank_map, "load_policy", lambda _: run.policy)
    monkeypatch.setattr(rank_episode, "RECORDED_WORLDS", 1)
    draws, render = [], rank_map.render_episode
    monkeypatch.setattr(rank_map, "render_episode", lambda *a: draws.append(a[2]) or render(*a))
    prompts = run.policy.processor.prompts
    monkeypatch.setattr(type(prompts), "rows", lambda _, texts: np.zeros(len(texts), np.int32))
    assert [*rank_map.write(folder, "press")] == [folder / "rank_map_press.mp4"]
    assert scene.size[0] <= draws[0].size <= scene.size[1]
    assert draws[0].size != 1
