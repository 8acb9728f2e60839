"""The loop: resuming, several devices, the best adapters, collapse."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from lorasp_jax.adapters import adaptation
from lorasp_jax.config import OptimConfig
from lorasp_jax.evaluation.callback import Evaluation
from lorasp_jax.peft import AdaLoRA
from lorasp_jax.reinforce import loop, setting, teacher, teaching
from lorasp_jax.reinforce.config import Learning
from lorasp_jax.training import best
from lorasp_jax.training.run import Callback
from lorasp_jax.training.run_folder import read_metrics, write_json
from tests.reinforce import rooms
from tests.runs import Terminate, leaves


@pytest.fixture(autouse=True)
def room(monkeypatch):
    monkeypatch.setattr(setting, "environment", lambda *_: rooms.Room())
    monkeypatch.setattr(teacher, "_CLONE_STEPS", 100)


@pytest.fixture
def leading(monkeypatch):
    """Let the policy imitate its teachers, however well they do."""
    monkeypatch.setattr(teaching, "_leads", lambda *_: True)


def train(folder, callbacks=(), *, resume=False, devices=1, **changes):
    run = rooms.start(folder, rooms.config(**changes), devices)
    loop.train(run, callbacks, resume=resume)
    return run


def adapters(run):
    return leaves(adaptation.split(run.policy.model)[1])


SDE = {"method": "ppo", "exploration": "sde"}


@pytest.fixture(
    scope="module",
    params=[{"method": "ppo"}, SDE, {"method": "teacher"}, {"method": "noise"}],
    ids=lambda changes: changes.get("exploration", changes["method"]),
)
def whole(request, tmp_path_factory):
    """An uninterrupted run."""
    patch = pytest.MonkeyPatch()
    patch.setattr(setting, "environment", lambda *_: rooms.Room())
    patch.setattr(teaching, "_leads", lambda *_: True)
    patch.setattr(teacher, "_CLONE_STEPS", 100)
    learn = dataclasses.replace(rooms.config().online, **request.param)
    yield train(tmp_path_factory.mktemp("whole"), online=learn)
    patch.undo()


def test_a_run_logs_what_the_report_shows(whole):
    rows = read_metrics(whole.folder)
    assert [row["step"] for row in rows] == [1, 2, 3, 4]
    assert np.all(np.diff([row["environment_steps"] for row in rows]) > 0)
    assert np.all(np.diff([row["minutes"] for row in rows]) > 0)
    names = {"rollout/press", "start_kl", "explained_variance/press"}
    assert any(row["updates"] for row in rows)
    if whole.config.online.method != "teacher":
        names |= {"kl", "clipped"}
        assert rows[0]["updates"] == 0  # the critic learns first
        assert ("noise_effect" in rows[0]) == (whole.config.online.method == "noise")
    else:
        names |= {"teacher/press", "task"}
    assert names <= set().union(*rows)
    kl = [row["start_kl"] for row in rows if row["updates"]]
    assert kl[0] < kl[-1]


def test_a_stopped_run_resumes_to_the_bit(whole, leading, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, [Terminate()], online=whole.config.online)
    assert len(read_metrics(tmp_path)) == 2
    resumed = train(tmp_path, resume=True, online=whole.config.online)
    expected = adapters(whole)
    for name, leaf in adapters(resumed).items():
        np.testing.assert_array_equal(leaf, expected[name])
    timed = ("minutes",)
    first, second = (
        [{k: v for k, v in row.items() if k not in timed} for row in read_metrics(run.folder)]
        for run in (whole, resumed)
    )
    assert first == second


def test_several_devices_learn_the_same(whole, leading, tmp_path):
    several = train(tmp_path, devices=4, online=whole.config.online)
    expected = adapters(whole)
    for name, leaf in adapters(several).items():
        np.testing.assert_allclose(leaf, expected[name], atol=2e-4, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("exploration", ["actions", "sde"])
def test_a_policy_learns_from_success_alone(tmp_path, monkeypatch, exploration):
    room = rooms.Room(num_envs=64, goal=0.15)
    monkeypatch.setattr(setting, "environment", lambda *_: room)
    learn = Learning(method="ppo", worlds=64, std=0.3, max_kl=0.2, max_start_kl=1e9)
    learn = dataclasses.replace(learn, exploration=exploration)
    train(tmp_path, online=learn, optim=OptimConfig(steps=20, batch_size=32, learning_rate=3e-3))
    rates = [row["rollout/press"] for row in read_metrics(tmp_path)]
    assert np.mean(rates[:4]) < 0.2
    assert np.mean(rates[-4:]) > 0.4


def test_teachers_that_are_good_enough_go_on_teaching(tmp_path, leading, monkeypatch):
    monkeypatch.setattr(teacher, "ENOUGH", 0.0)
    learn = dataclasses.replace(rooms.config().online, method="teacher")
    run = train(tmp_path, online=learn)
    assert [row["updates"] for row in read_metrics(run.folder)] == [4] * 4


def test_success_of_a_teacher_is_enough_to_go_on():
    config, clock = rooms.config(online=Learning(worlds=64)), loop._Clock.__new__(loop._Clock)
    clock._first = {"rollout/press": 0.0}
    assert not clock.collapse(config, {"rollout/press": 0.0, "teacher/press": 0.1})
    assert "no episode succeeded" in clock.collapse(config, {"rollout/press": 0.0})


class Judge(Callback):
    """Evaluates as told."""

    def __init__(self, *rates):
        self.rates = rates
        self.seen = {}

    def on_log(self, run, step, metrics):
        self.seen[step] = adapters(run)
        return {"success/press": self.rates[step - 1]}


def test_a_start_that_no_iteration_betters_is_kept(tmp_path):
    start = {"success": 0.7, "episodes": 10, "ci95": [0.4, 0.9]}
    write_json(tmp_path / "before.json", {"press": start})
    run = train(tmp_path, [Judge(0.2, 0.6, 0.4, 0.6)])
    assert "kept the adapters of the start" in run.console.file.getvalue()


def test_the_best_adapters_are_kept(tmp_path):
    judge = Judge(0.2, 0.6, 0.4, 0.6)
    run = train(tmp_path, [judge])
    assert best.error(tmp_path) == pytest.approx(0.4)
    for name, leaf in adapters(run).items():
        np.testing.assert_array_equal(leaf, judge.seen[2][name])
    assert "kept the adapters of iteration 2" in run.console.file.getvalue()
    (tmp_path / best.WEIGHTS).write_bytes(b"damaged")
    with pytest.raises(ValueError, match=r"delete best\.json and add --resume"):
        train(tmp_path, resume=True)
    (tmp_path / best.BEST).unlink()
    for name, leaf in adapters(train(tmp_path, resume=True)).items():
        np.testing.assert_array_equal(leaf, judge.seen[4][name])


def test_a_policy_far_from_the_start_stops_the_run(tmp_path):
    learn = dataclasses.replace(rooms.config().online, max_start_kl=1e-6)
    run = train(tmp_path, online=learn)
    assert len(read_metrics(tmp_path)) == 2
    expected = "stopped after iteration 2: the KL divergence from the start policy is"
    assert expected in run.console.file.getvalue().replace("\n", " ")
    resumed = train(tmp_path, online=learn, resume=True)
    assert len(read_metrics(tmp_path)) == 2
    assert expected in resumed.console.file.getvalue().replace("\n", " ")


def test_a_run_ends_in_time(tmp_path):
    learn = dataclasses.replace(rooms.config().online, minutes=1e-6)
    run = train(tmp_path, online=learn)
    assert len(read_metrics(tmp_path)) == 1
    assert "stopped after iteration 1: it has learned for" in run.console.file.getvalue()


class Measured(Evaluation):
    """Measures more success in every evaluation; writes nothing."""

    count = 0

    def on_start(self, run):
        pass

    def on_end(self, run):
        pass

    def _evaluate_tasks(self, run, when, episodes=0):
        self.count += 1
        return {"press": SimpleNamespace(success=self.count / 10)}


@pytest.mark.parametrize("limits", [{"minutes": 1e-6}, {"max_start_kl": 1e-6}])
def test_a_run_that_stops_early_evaluates_its_last_policy(tmp_path, limits):
    learn = dataclasses.replace(rooms.config().online, **limits)
    run = train(tmp_path, [Measured(media=False)], online=learn)
    last = read_metrics(tmp_path)[-1]
    assert last["step"] < run.config.optim.steps
    assert last["success/press"] == 0.1
    kept = f"kept the adapters of iteration {last['step']:.0f}"
    assert kept in run.console.file.getvalue()


def test_lost_success_stops_the_run():
    assert "fell from 32 to 10 of 64 episodes" in collapse(32, 10)
    assert not collapse(6, 2)  # likely by chance
    assert not collapse(60, 45)
    assert "no episode succeeded" in collapse(0, 0)
    assert not collapse(1, 0)
    assert not collapse(0, 0, reward="dense")


def collapse(first, now, **changes):
    config = rooms.config(online=Learning(worlds=64, **changes))
    clock = loop._Clock.__new__(loop._Clock)
    clock._first = {"rollout/press": first / 64}
    return clock.collapse(config, {"rollout/press": now / 64, "updates": 1})


def test_a_run_without_any_success_stops(tmp_path):
    run = train(tmp_path, online=Learning(worlds=8, std=1e-3))
    assert len(read_metrics(tmp_path)) == 1
    assert "no episode succeeded" in run.console.file.getvalue()


def test_the_divergence_from_the_start_is_that_of_all_valid_chunks(tmp_path):
    fixed, state, _ = setting.prepare(rooms.start(tmp_path, rooms.config()))
    seen = []

    def means(adapters, frozen, chunks, index):
        seen.append(index)
        return np.zeros((8, 4, 8))

    programs = SimpleNamespace(means=means, divergence=fixed.programs.divergence)
    fixed = fixed._replace(programs=programs)
    rows = {"loss": np.ones(1), "in_a_row": np.zeros(1, int)}
    fixed.summary(state, SimpleNamespace(step=None), np.arange(64) % 2 == 1, rows)
    assert seen[0].tolist() == [1, 9, 17, 27, 35, 45, 53, 63]


@pytest.mark.parametrize("name", ["worlds", "teacher_worlds"])
def test_devices_must_divide_the_worlds(tmp_path, name):
    learn = dataclasses.replace(rooms.config().online, method="teacher", **{name: 10})
    run = rooms.start(tmp_path, rooms.config(online=learn), 4)
    expected = rf"online.{name} must be a multiple of the number of devices \(4\), got 10"
    with pytest.raises(ValueError, match=expected):
        setting.prepare(run)


def test_ada_lora_is_refused(tmp_path):
    run = rooms.start(tmp_path, rooms.config(peft=AdaLoRA()))
    with pytest.raises(ValueError, match="ada_lora needs a number of steps"):
        setting.prepare(run)
