"""Evaluation during training: when it runs, and that training does not wait for the videos."""

import dataclasses
import io
import threading
from typing import Any, cast

import jax.numpy as jnp
import pytest
from rich.console import Console

from lorasp_jax.config import EvaluationConfig
from lorasp_jax.evaluation import Result, callback
from lorasp_jax.evaluation.callback import Evaluation
from lorasp_jax.models.sampling import Sampler
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.prompt_table import Ids, PromptTable
from lorasp_jax.training.run import Run
from tests.runs import CONFIG, random_episodes


@dataclasses.dataclass(frozen=True)
class Inputs:
    """A processor as far as evaluation looks into it, with rows of good, bad and plain prompts."""

    prompts: Any
    datasets: None = None


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.setattr(callback, "compiled_rollout", lambda _, task: (task, None))
    settings = EvaluationConfig(episodes=8, num_envs=4, execute_steps=1, every=100)
    optim = dataclasses.replace(CONFIG.optim, steps=300)
    config = dataclasses.replace(CONFIG, evaluation=settings, optim=optim, log_every=40)
    run = Run(config, tmp_path, Console(file=io.StringIO()), "")
    run.episodes = {task: random_episodes(task, 0) for task in config.tasks}
    unused = cast(Any, None)
    table = PromptTable(Ids(jnp.arange(3)[:, None], jnp.ones((3, 1), bool)), instructions=("go",))
    inputs = cast(Any, Inputs(table))
    run.policy = Policy(Sampler([], unused, unused, ()), inputs)
    return run


def test_evaluation_runs_at_the_next_log_step(run, monkeypatch):
    evaluated, rendered, may_render = [], [], threading.Event()

    def evaluate(policy, env, key, episodes, **_):
        evaluated.append((env, episodes))
        return Result(0.5, episodes, (0.4, 0.6), (), 30.0, {}, {}, poses=(), draw="drawn")

    def write_video(env, poses, path, draw):
        assert may_render.wait(60)
        assert draw == "drawn"
        rendered.append(env)
        path.touch()

    monkeypatch.setattr(callback, "evaluate", evaluate)
    monkeypatch.setattr(callback.video, "write_episode", write_video)
    evaluation = Evaluation()
    steps = [*range(40, 300, 40), 300]
    with run.timed("train"):
        logged = {step: evaluation.on_log(run, step, {}) for step in steps[:3]}
    assert {step for step, value in logged.items() if value} == {120}
    assert logged[120] == {"success/press": 0.5, "success/pick_place": 0.5}
    assert sorted(evaluated) == [("pick_place", 4), ("press", 4)]  # one batch of worlds
    assert "press at step 120: 50.0 % success" in run.console.file.getvalue()
    assert not rendered  # training did not wait
    may_render.set()
    logged = {step: evaluation.on_log(run, step, {}) for step in steps[3:]}
    assert {step for step, value in logged.items() if value} == {200}  # step 300 is left to on_end
    evaluation._video_thread.shutdown()
    assert rendered == 2 * [*run.config.tasks]
    assert {path.name for path in run.folder.glob("*.mp4")} == {
        "rollout_press.mp4",
        "rollout_pick_place.mp4",
    }
    assert set(run.seconds) == {"train", "evaluate", "total"}
    phases = run.seconds["train"] + run.seconds["evaluate"]
    assert phases <= run.seconds["total"]  # evaluation is not counted as training


def test_rows_that_the_device_computes_wrongly_are_reported(run, monkeypatch):
    outcomes = tuple(index % 2 == 0 for index in range(64))
    result = Result(0.5, 64, (0.4, 0.6), outcomes, 30.0, {}, {}, poses=(), draw=None)
    monkeypatch.setattr(callback, "evaluate", lambda *_, **__: result)
    Evaluation(media=False).on_log(run, 120, {})
    assert "warning: success depends on bit 0 of an episode's index" in run.console.file.getvalue()


@pytest.mark.parametrize(("learned", "first"), [(False, 2), (True, 0)])
def test_the_base_is_not_asked_for_good_actions(run, monkeypatch, learned, first):
    """The trained policy is, also where another run starts from it."""
    asked = []

    def evaluate(policy, env, key, episodes, **_):
        asked.append(policy.processor.prompts)
        return Result(0.5, episodes, (0.4, 0.6), (), 30.0, {}, {}, poses=(), draw=None)

    monkeypatch.setattr(callback, "evaluate", evaluate)
    evaluation = Evaluation(media=False, learned=learned)
    evaluation.on_start(run)
    evaluation.on_log(run, 120, {})
    assert [int(prompts.start.ids[0, 0]) for prompts in asked] == [first, first, 0, 0]


def test_evaluation_can_be_disabled(run, monkeypatch):
    monkeypatch.setattr(callback, "evaluate", lambda *_, **__: pytest.fail("evaluated"))
    settings = dataclasses.replace(run.config.evaluation, every=0)
    run.config = dataclasses.replace(run.config, evaluation=settings)
    assert Evaluation().on_log(run, 40, {}) == {}


def test_a_task_has_the_same_layouts_in_single_and_multi_task_runs(run, monkeypatch):
    keys = []

    def evaluate(policy, env, key, episodes, **_):
        keys.append((env, key))
        return Result(0.5, episodes, (0.4, 0.6), (), 30.0, {}, {}, poses=())

    monkeypatch.setattr(callback, "evaluate", evaluate)
    for tasks in (run.config.tasks, run.config.tasks[1:]):
        run.config = dataclasses.replace(run.config, tasks=tasks)
        evaluation = Evaluation()
        for when in ("before", "at step 100", "after"):
            evaluation._evaluate_tasks(run, when)
    pick_place = [key for task, key in keys if task == "pick_place"]
    before, during, after = pick_place[:3]
    assert before == during != after
    assert pick_place[3:] == [before, during, after]
    assert before not in [key for task, key in keys if task == "press"]
