"""Held-out episodes: never trained on, measured repeatably, and the best adapters are kept."""

import dataclasses
import functools
import re
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lorasp_jax.adapters import adaptation
from lorasp_jax.config import DataConfig
from lorasp_jax.data import cache
from lorasp_jax.data.batches import RawBatch, draw, encode
from lorasp_jax.data.lerobot import LeRobot
from lorasp_jax.evaluation import held_out, validation
from lorasp_jax.evaluation.__main__ import main
from lorasp_jax.evaluation.held_out import measure, windows
from lorasp_jax.evaluation.validation import Validation
from lorasp_jax.models.noise_actor import NoiseActor, attach
from lorasp_jax.report.html import held_out_verdict, write_report
from lorasp_jax.training import export, run_folder
from lorasp_jax.training.loop import train
from lorasp_jax.training.run import Callback
from lorasp_jax.training.run_folder import read_json, read_metrics, to_json, write_json
from tests.data.lerobots import golden
from tests.runs import CONFIG, Terminate, leaves
from tests.training.test_dataset import prepare

KEY, OUT = jax.random.key(0), (1, 2)
DATA = DataConfig(source=str(golden("v3")), validation=("episode_1", "episode_2"))
CONFIG = dataclasses.replace(
    CONFIG,
    data=DATA,
    model=dataclasses.replace(CONFIG.model, max_tokens=16),
    evaluation=dataclasses.replace(
        CONFIG.evaluation, validate_every=2, execute_steps=1, denoise_steps=2
    ),
)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A run on two of the four golden episodes, in a user's cache, with the dummy backbone."""
    folder = tmp_path_factory.mktemp("recorded")
    cache.write([LeRobot(golden("v3"))], folder / "mine", lambda *_: None)
    data = dataclasses.replace(DATA, source=str(folder / "mine"))
    with pytest.MonkeyPatch.context() as patch:
        config = dataclasses.replace(CONFIG, data=data)
        (folder / "run").mkdir()
        return prepare(folder / "run", patch, data.source, config=config)


def test_held_out_episodes_are_not_trained_on(recorded):
    source = LeRobot(golden("v3"))
    learned = [source.episode(n, ()) for n in range(4) if n not in OUT]
    actions = np.concatenate([episode.action[0] for episode in learned])
    slots = np.array(recorded.policy.processor.state_slots)
    known = recorded.policy.processor.statistics.action["mean"][slots]
    np.testing.assert_allclose(known, actions.mean(0), atol=1e-6)
    drawn = draw(jax.random.key(0), jax.device_put(recorded.steps), batch_size=512, chunk=1)
    states = {row.tobytes() for episode in learned for row in np.asarray(episode.state[0])}
    seen = {row.tobytes() for row in np.asarray(drawn.state)}
    assert seen <= states
    assert len(seen) > 0.9 * len(states)


def test_errors_by_hand():
    """Two windows of two actions, the last of which lies past the end of its episode."""
    recorded = np.array([[[0.0, 0.0], [2.0, 0.8]], [[4.0, 1.6], [9.0, 9.0]]], np.float32)
    inside = np.array([[True, True], [True, False]])
    raw = RawBatch({}, np.zeros((2, 2)), recorded, inside, np.zeros(2, np.int32))
    found = held_out._errors(np.array([[[1.0, 0.0], [2.0, 0.0]], [[4.0, 0.0], [0.0, 0.0]]]), raw)
    np.testing.assert_allclose(found.action, [1 / 3, 0.8], rtol=1e-6)
    np.testing.assert_allclose(found.first, [0.5, 0.8], rtol=1e-6)
    spread = np.std([0, 2, 4]), np.std([0, 0.8, 1.6])
    expected = [(0.5 / spread[0] + 0.8 / spread[1]) / 2, (0.8 / spread[1]) / 2]
    np.testing.assert_allclose(found.horizon, expected, rtol=1e-6)
    assert found.mean == pytest.approx((1 / 3 / spread[0] + 0.8 / spread[1]) / 2)


def test_a_dimension_that_hardly_moves_does_not_decide():
    """Sensor noise of 10 µm: 1 mm off there is little, .3 rad off elsewhere is much."""
    rng = np.random.default_rng(0)
    recorded = rng.normal(size=(64, 4, 7)).astype(np.float32) * np.array([0.3] * 6 + [1e-5])
    raw = RawBatch({}, recorded[:, 0], recorded, np.ones((64, 4), bool), np.zeros(64, np.int32))
    close = held_out._errors(recorded + np.array([0.01] * 6 + [1e-3]), raw)
    far = held_out._errors(recorded + np.array([0.3] * 6 + [0.8e-3]), raw)
    assert close.mean < 0.1 < 0.8 < far.mean


def test_windows(recorded):
    """Evenly spaced; an episode's first window has its state as the previous action."""
    source = LeRobot(golden("v3"))
    found = windows(source, OUT, recorded.policy, every=10)
    assert found.step.tolist() == [0, 10, 20, 30, 0, 10, 20, 30]
    assert found.episode.tolist() == 4 * [1] + 4 * [2]
    episode = source.episode(1, ())
    np.testing.assert_array_equal(found.raw.state[1], episode.state[0, 10])
    np.testing.assert_array_equal(found.previous[1], episode.action[0, 9])
    np.testing.assert_array_equal(found.previous[0], episode.state[0, 0])
    np.testing.assert_array_equal(found.raw.actions[1, 0], episode.action[0, 10])
    assert len(windows(source, range(4), recorded.policy).task) == source.num_steps


class Watcher(Callback):
    """Keeps the adapters of every log step."""

    def __init__(self):
        self.seen = []

    def on_log(self, run, step, metrics):
        self.seen.append(leaves(_adapters(run)))


def test_poses_are_no_joint_targets(recorded):
    class Poses(LeRobot):
        def episode(self, number, cameras=None):
            return dataclasses.replace(super().episode(number, cameras), actions="end_effector")

    with pytest.raises(ValueError, match="end_effector"):
        windows(Poses(golden("v3")), OUT, recorded.policy)


def test_displacements_hold_still_at_zero(recorded):
    """Actions of another length than states are no joint targets, nor those near zero."""

    class Moves(LeRobot):
        def episode(self, number, cameras=None):
            episode = super().episode(number, cameras)
            return dataclasses.replace(episode, action=episode.action - episode.state)

    moves = windows(Moves(golden("v3")), OUT, recorded.policy, every=10)
    assert not moves.still.any()
    assert dict(moves.units)["joint_1"] == 1

    class Shorter(LeRobot):
        def episode(self, number, cameras=None):
            episode = super().episode(number, cameras)
            return dataclasses.replace(episode, action=episode.action[..., :5])

    found = windows(Shorter(golden("v3")), OUT, recorded.policy, every=10)
    assert found.still.shape == found.previous.shape == (8, 5)
    assert not found.still.any()
    assert not found.previous[0].any()
    assert found.previous[1].any()


def test_units(recorded):
    """Joint targets are shown in degrees and mm; displacements and other units as recorded."""
    found = windows(LeRobot(golden("v3")), OUT, recorded.policy, every=10)
    assert found.units[0] == ("joint_1 [°]", pytest.approx(180 / np.pi))
    assert found.units[-1] == ("gripper [mm]", 1000)
    joint, gripper = found.units[0], found.units[-1]
    for scale, shown in (
        ([60.0] * 6 + [1], [("joint_1", 1), gripper]),
        ([1.0] * 6 + [500], [joint, ("gripper", 1)]),
        ([60.0] * 6 + [500], [("joint_1", 1), ("gripper", 1)]),
    ):
        raw = dataclasses.replace(found.raw, actions=found.raw.actions * np.array(scale))
        units = dataclasses.replace(found, raw=raw).units
        assert [units[0], units[-1]] == shown
    unnamed = dataclasses.replace(found, names=())
    raw = dataclasses.replace(found.raw, actions=found.raw.actions[..., 1:])
    shorter = dataclasses.replace(unnamed, raw=raw, targets=False, grippers=(5,))
    assert [name for name, _ in shorter.units] == [f"action {i}" for i in range(1, 7)]
    small = dataclasses.replace(found.raw, actions=0.1 * found.raw.actions)
    two = dataclasses.replace(unnamed, raw=small, grippers=(2, 6))
    assert [*dict(two.units)][1:4] == ["joint_2 [°]", "gripper (3) [mm]", "joint_3 [°]"]
    odd = ("a [x]", "a [x]", "$b$", "c\n", *"efg")
    assert [*dict(dataclasses.replace(found, names=odd).units)][:4] == [
        "a [x] (1) [°]",
        "a [x] (2) [°]",
        "$b$ [°]",
        "c [°]",
    ]


def test_errors_by_instruction(recorded):
    """The worst first; together they are the error of all windows."""
    found = windows(LeRobot(golden("v3")), range(4), recorded.policy, every=10)
    result = measure(recorded.policy, found, num_steps=1)
    assert {*result.instructions} == {*found.phrase}
    (worst, *_), (best, *_) = result.instructions.values()
    assert best <= result.policy.mean <= worst
    phrase = next(iter(result.instructions))
    rows = np.array([other == phrase for other in found.phrase])
    inside = np.asarray(found.raw.inside)[rows]
    spread = held_out._spread(found.raw)[rows]
    off = np.abs(result.actions - found.raw.actions)[rows] / spread
    assert worst == pytest.approx(off[inside].mean(), rel=1e-5)
    still = np.abs(found.still[:, None] - found.raw.actions)[rows] / spread
    assert result.instructions[phrase][1] == pytest.approx(still[inside].mean(), rel=1e-5)


def test_noise_that_a_policy_has_learned_counts(recorded):
    policy, found = recorded.policy, windows(LeRobot(golden("v3")), OUT, recorded.policy, every=10)
    actor = NoiseActor.blank(policy.model.config, std=0.999999, widths=(4,))
    steered = dataclasses.replace(policy, model=attach(policy.model, actor))
    program = functools.partial(held_out._program.__wrapped__)  # has a cache of its own
    with (
        mock.patch.object(held_out, "_program", jax.jit(program, static_argnames="num_steps")),
        mock.patch.object(jax.random, "normal", lambda _, shape: jnp.zeros(shape)),
    ):
        expected = held_out.sample(policy, found, num_steps=2)  # of no noise
    plain, other = (measure(x, found, num_steps=2) for x in (policy, steered))
    np.testing.assert_allclose(other.actions, expected, atol=1e-2)
    assert np.abs(plain.actions - expected).max() > 0.1
    assert other.loss == pytest.approx(plain.loss, rel=1e-5)


def test_fewer_windows_on_a_cpu(recorded, monkeypatch):
    """They take most of the time of a small run."""
    limits = []
    monkeypatch.setattr(validation, "windows", lambda *_, limit: limits.append(limit) or 1 / 0)
    for scale in ("cpu", "accelerator"):
        run = dataclasses.replace(recorded, config=dataclasses.replace(CONFIG, scale=scale))
        run.policy = recorded.policy
        with pytest.raises(ZeroDivisionError):
            Validation().on_log(run, 2, {})
    assert limits == [64, 256]
    few = windows(LeRobot(golden("v3")), OUT, recorded.policy, limit=10)
    assert np.bincount(few.episode).tolist() == [0, 5, 5]


def test_a_run_measures_keeps_the_best_and_resumes(recorded, tmp_path, monkeypatch):
    """The error rises after step 2: its adapters are evaluated and exported, also on a resume."""
    errors = iter([0.5, 0.9, 0.5, 0.9, 0.9, 0.9])
    real = validation.measure

    def fake(policy, found, **options):
        result = real(policy, found, **options)
        return dataclasses.replace(
            result, policy=dataclasses.replace(result.policy, mean=next(errors))
        )

    monkeypatch.setattr(validation, "measure", fake)
    kept = []
    for name in ("whole", "halved"):
        folder = tmp_path / name
        folder.mkdir()
        run = dataclasses.replace(recorded, folder=folder)
        run.policy, run.programs = recorded.policy, recorded.programs
        write_json(folder / "config.json", to_json(run.config))
        if name == "whole":
            watcher = Watcher()
            train(run, [Validation(), watcher])
            first = watcher.seen[0]
        else:
            watcher = Terminate()
            with pytest.raises(KeyboardInterrupt):
                train(run, [Validation(), watcher])
            train(run, [Validation(), watcher], resume=True)
        kept.append(leaves(_adapters(run)))
        assert read_json(folder / "validation.json")["kept"] == 2
        row = read_metrics(folder)[-1]
        assert row["validation/action_error"] == 0.9
        assert {"validation/loss", "validation/joint_6", "validation/gripper"} <= row.keys()
        page = write_report(folder).read_text()
        assert all(f"<td>{text}</td>" in page for text in recorded.recordings.instructions)
        assert "Held-out episodes" in page
        assert page.count('alt="recorded and predicted joints"') == 1
    for name, value in first.items():
        np.testing.assert_array_equal(kept[0][name], value)
        np.testing.assert_array_equal(kept[1][name], value)


def _adapters(run):
    return adaptation.split(run.policy.model)[1]


def test_the_same_policy_gives_the_same_values(recorded):
    found = windows(LeRobot(golden("v3")), OUT, recorded.policy, every=10)
    first, again = (measure(recorded.policy, found, num_steps=2) for _ in range(2))
    assert first.scalars == again.scalars
    assert first.actions.shape == (8, recorded.policy.model.config.chunk, 7)


def test_the_loss_is_that_of_training(recorded):
    """Of the model that trains, although the sampler's weights give it."""
    policy = recorded.policy
    found = windows(LeRobot(golden("v3")), OUT, policy, every=10)
    encoded = jax.jit(lambda raw: encode(KEY, raw, policy.processor, state_noise=0.0))
    batch = encoded(found.raw)
    wrapped = jax.tree.map(lambda x: jnp.concatenate([x, x]), batch)  # to the size of a batch
    key = jax.random.split(jax.random.fold_in(KEY, 0))[0]
    inputs, mask = (wrapped.observation, wrapped.actions), wrapped.action_mask
    loss = jax.jit(jax.vmap(lambda key: policy.model.loss(key, *inputs, action_mask=mask)[0]))
    losses = loss(jax.random.split(key, held_out._NOISES))
    valid = np.broadcast_to(batch.action_mask, (held_out._NOISES, *batch.action_mask.shape))
    expected = np.asarray(losses)[:, :8][valid].mean()
    assert measure(policy, found, num_steps=1).loss == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("errors", "named"),
    [
        ((0.9, 0.5, 0.4), "step 3"),
        ((0.9, 0.5, 0.8), "step 2.*overfit"),
        ((2.0, 1.5, 1.2), "step 3.*nothing"),
    ],
)
def test_verdict(errors, named):
    floors = {f"validation/{name}/action_error": 1.0 for name in ("hold_still", "repeat")}
    rows = [{"step": n, "validation/action_error": x, **floors} for n, x in enumerate(errors, 1)]
    assert re.search(named, held_out_verdict(rows))


def test_runs_without_held_out_episodes_have_the_settings_of_before():
    plain = dataclasses.replace(CONFIG, data=DataConfig())
    assert not {"keep", "validation"} & (to_json(plain).keys() | to_json(plain)["data"].keys())
    assert run_folder.changed_settings(
        to_json(dataclasses.replace(CONFIG, data=DataConfig(source="x", validation=("0",)))),
        to_json(dataclasses.replace(CONFIG, data=DataConfig(source="x"))),
    )
    with pytest.raises(ValueError, match=r"data\.source"):
        DataConfig(validation=("0.1",))


@pytest.mark.parametrize(("words", "expected"), [([], 4), (["--denoise-steps", "2"], 2)])
def test_evaluate_takes_the_flow_steps_of_the_run(words, expected, recorded, tmp_path, monkeypatch):
    evaluation = dataclasses.replace(CONFIG.evaluation, denoise_steps=4)
    write_json(
        tmp_path / "config.json", to_json(dataclasses.replace(CONFIG, evaluation=evaluation))
    )
    monkeypatch.setattr(export, "load_policy", lambda *_, **__: recorded.policy)
    monkeypatch.setattr(export, "describe", lambda _: {"control_dt": 0.1})
    measured = mock.Mock(side_effect=ValueError("measured"))
    monkeypatch.setattr(held_out, "measure", measured)
    assert main([str(tmp_path), "--data", str(golden("v21")), *words]) == 2
    assert measured.call_args.kwargs == {"num_steps": expected}


def test_evaluate_on_another_dataset(recorded, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(export, "load_policy", lambda *_, **__: recorded.policy)
    monkeypatch.setattr(export, "describe", lambda _: {"control_dt": 0.1})
    run = str(recorded.folder)
    monkeypatch.setenv("COLUMNS", "200")
    arguments = [run, "--data", str(golden("v21")), "--out", str(tmp_path / "out")]
    assert main([*arguments, "--episodes", "0", "3", "--denoise-steps", "2"]) == 0
    printed = capsys.readouterr().out
    assert all(
        text in printed for text in ("hold still", "joint_1", *recorded.recordings.instructions)
    )
    assert len(list((tmp_path / "out").glob("*.png"))) == 1
    assert main([*arguments, "--episodes", "4"]) == 2
    assert "0 to 3" in capsys.readouterr().err
    monkeypatch.setattr(export, "describe", lambda _: {"control_dt": 0.2})
    assert main(arguments) == 2
    assert "--every" in capsys.readouterr().err
    file = tmp_path / "others.toml"
    file.write_text(f'path = "{golden("v21")}"')
    assert main([run, "--data", str(file)]) == 2
    printed = capsys.readouterr().err
    assert "every = N" in printed
    assert "--every" not in printed  # which is refused beside a file
    file.write_text(f'path = "{golden("v21")}"\nevery = 2')
    assert main([run, "--data", str(file), "--out", str(tmp_path / "out"), "--episodes", "9"]) == 2
    assert "0 to 3" in capsys.readouterr().err  # the period fits
    monkeypatch.setattr(export, "describe", lambda _: {"control_dt": 0.05})
    assert main(arguments) == 2
    assert "more often" in capsys.readouterr().err
