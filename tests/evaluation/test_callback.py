"""Success while training: when it is measured, and that training does not wait for the films."""

import dataclasses
import io
import threading
from typing import Any, cast

import pytest
from rich.console import Console

from lorasp_jax.config import EvaluationConfig
from lorasp_jax.evaluation import Result
from lorasp_jax.evaluation.callback import Evaluation
from lorasp_jax.training.run import Run
from tests.runs import CONFIG, random_episodes


@pytest.fixture
def run(tmp_path):
    settings = EvaluationConfig(episodes=8, num_envs=4, execute_steps=1, every=100)
    optim = dataclasses.replace(CONFIG.optim, steps=300)
    config = dataclasses.replace(CONFIG, evaluation=settings, optim=optim, log_every=40)
    run = Run(config, tmp_path, Console(file=io.StringIO()), "")
    run.episodes = {task: random_episodes(task, 0) for task in config.tasks}
    run.policy = cast(Any, None)  # what measures it is not called
    return run


def test_every_hundred_steps_at_the_next_log_line(run):
    asked, filmed, go = [], [], threading.Event()

    def evaluate(policy, env, key, episodes, **_):
        asked.append((env, episodes))
        return Result(0.5, episodes, (0.4, 0.6), 30.0, {}, {}, poses=())

    def film(env, poses, path):
        assert go.wait(60)
        filmed.append(env)
        path.touch()

    evaluation = Evaluation(lambda _, task: (task, None), evaluate, film)
    steps = [*range(40, 300, 40), 300]
    with run.timed("train"):
        found = {step: evaluation.on_log(run, step, {}) for step in steps[:3]}
    assert {step for step, value in found.items() if value} == {120}
    assert found[120] == {"success/press": 0.5, "success/pick_place": 0.5}
    assert sorted(asked) == [("pick_place", 4), ("press", 4)]  # one batch of worlds
    assert "press at step 120: 50.0 % success" in run.console.file.getvalue()
    assert not filmed  # and yet training went on
    go.set()
    found = {step: evaluation.on_log(run, step, {}) for step in steps[3:]}
    assert {step for step, value in found.items() if value} == {200}  # 300 is the end's
    evaluation._films.shutdown()
    assert filmed == 2 * [*run.config.tasks]
    assert {path.name for path in run.folder.glob("*.mp4")} == {
        "rollout_press.mp4",
        "rollout_pick_place.mp4",
    }
    assert set(run.seconds) == {"train", "evaluate", "total"}
    parts = run.seconds["train"] + run.seconds["evaluate"]
    assert parts <= run.seconds["total"]  # an evaluation is not counted as training, too


def test_without_it_nothing_is_measured(run):
    evaluation = Evaluation(evaluate=lambda *_, **__: pytest.fail("it measures"))
    settings = dataclasses.replace(run.config.evaluation, every=0)
    run.config = dataclasses.replace(run.config, evaluation=settings)
    assert evaluation.on_log(run, 40, {}) == {}
