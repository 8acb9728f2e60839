"""Runs on several datasets: weighted, each with its own statistics, and replay."""

import dataclasses
import re
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from envs.datasets import rlds
from lorasp_jax import models
from lorasp_jax.adapters import adaptation
from lorasp_jax.config import DataConfig
from lorasp_jax.data import cache
from lorasp_jax.data.batches import draw, encode
from lorasp_jax.data.opening import open_source
from lorasp_jax.evaluation.held_out import episodes_of, measure, sample, windows
from lorasp_jax.extras.serving.loading import load_run
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.report.html import write_report
from lorasp_jax.training import dataset, early, export, setup, start
from lorasp_jax.training.batches import DrawnBatches
from lorasp_jax.training.cost import fit
from lorasp_jax.training.distributed import mesh as meshes
from lorasp_jax.training.loop import train
from lorasp_jax.training.overrides import parse
from lorasp_jax.training.replay import replayed_tasks
from lorasp_jax.training.run import Run
from lorasp_jax.training.run_folder import CACHE, read_json, to_json, write_json
from tests import ROOT
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, Terminate, leaves, random_episodes
from tests.training.test_dataset import prepare

EVALUATION = dataclasses.replace(CONFIG.evaluation, execute_steps=1, validate_every=2)
NAMES = ("near", "far")
CAMERAS = {"near": ["side", "wrist"], "far": ["side"]}


def recorded(seed, scale):
    """Three recordings of press, in other units by `scale`."""
    group = random_episodes("press", seed)
    numbers = {"state": scale * group.state + scale, "action": scale * group.action - scale}
    return dataclasses.replace(group, physics_dt=0.0, **numbers)


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """An RLDS dataset, and a cache in a hundredth of its units without the wrist camera."""
    folder = tmp_path_factory.mktemp("sources")
    rlds.write(recorded(0, 1.0), folder / "near")
    far = recorded(1, 0.01)
    side = {"top": far.image["side"]}
    rlds.write(dataclasses.replace(far, image=side), folder / "rlds")
    cache.write([open_source(folder / "rlds")], folder / "cache", lambda *_: None)
    (folder / "far.toml").write_text('path = "cache"\n[cameras]\nside = "top"\n')
    return str(folder / "near"), str(folder / "far.toml")


def config(sources, **data):
    data = DataConfig(sources, **{"validation": ("2",), "statistics": "each", **data})
    return dataclasses.replace(CONFIG, data=data, evaluation=EVALUATION)


@pytest.fixture(scope="module")
def run(sources, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("run")
        return prepare(folder, patch, "", config=config(sources, weights=(3.0, 1.0)))


def learned(run, name):
    """Return the recordings of a dataset that are not held out, `[N, 7]` each."""
    group = recorded(*((0, 1.0) if name == "near" else (1, 0.01)))
    numbers = [n for n in range(3) if n + 3 * NAMES.index(name) not in run.held_out]
    steps = [(n, slice(int(group.length[n]))) for n in numbers]
    return (np.concatenate([x[s] for s in steps]) for x in (group.state, group.action))


def test_each_dataset_has_its_own_statistics(run):
    """Of the episodes that are not held out, of which each dataset has some."""
    assert len(run.held_out) == 2
    assert {number // 3 for number in run.held_out} == {0, 1}
    processor = run.policy.processor
    slots = np.array(processor.state_slots)
    for index, name in enumerate(NAMES):
        own = processor.of_dataset(name).statistics
        for kind, rows in zip(("state", "action"), learned(run, name), strict=True):
            found = getattr(own, kind)["mean"]
            np.testing.assert_allclose(found[slots], rows.mean(0), rtol=1e-4, atol=1e-6)
            stacked = getattr(processor.datasets.statistics, kind)["mean"][index]
            np.testing.assert_array_equal(stacked, found)
    first = processor.of_dataset("near").statistics
    jax.tree.map(np.testing.assert_array_equal, processor.statistics, first)


def test_windows_are_drawn_by_weight_and_normalized_by_their_dataset(run):
    steps = jax.device_put(dataclasses.replace(run.steps, image={}))
    many = jax.jit(lambda key: draw(key, steps, batch_size=20_000, chunk=1).dataset)
    assert np.mean(many(jax.random.key(0))) == pytest.approx(0.25, abs=0.02)
    raw = draw(jax.random.key(1), jax.device_put(run.steps), batch_size=32, chunk=4)
    processor, which = run.policy.processor, np.asarray(raw.dataset)
    assert set(which) == {0, 1}
    batch = encode(jax.random.key(2), raw, processor, state_noise=0.0)
    for index, name in enumerate(NAMES):
        rows, own = which == index, processor.of_dataset(name)
        alone = dataclasses.replace(jax.tree.map(lambda x, r=rows: x[r], raw), dataset=None)
        expected = encode(jax.random.key(2), alone, own, state_noise=0.0)
        np.testing.assert_allclose(batch.actions[rows], expected.actions, atol=1e-6)
        states = batch.observation.state[rows], expected.observation.state
        np.testing.assert_allclose(*states, atol=1e-6)
        assert 0.1 < np.abs(batch.observation.state[rows]).max() < 10
    slots = dict((name, slot) for slot, name in processor.cameras if name)
    masks = batch.observation.image_masks
    assert masks[slots["side"]].all()
    np.testing.assert_array_equal(masks[slots["wrist"]], which == 0)
    assert (np.asarray(batch.observation.images[slots["wrist"]])[which == 1] == -1).all()


def test_held_out_windows_act_by_their_dataset(run, tmp_path):
    found = windows(run.recordings, run.held_out, run.policy, every=5)
    which = np.asarray(found.raw.dataset)
    np.testing.assert_array_equal(which, found.episode // 3)
    chunks = sample(run.policy, found, num_steps=2)
    for index, name in enumerate(NAMES):
        raw = dataclasses.replace(found.raw, dataset=None)
        own = dataclasses.replace(run.policy, processor=run.policy.processor.of_dataset(name))
        expected = sample(own, dataclasses.replace(found, raw=raw), num_steps=2)
        rows = which == index
        np.testing.assert_allclose(chunks[rows], expected[rows], rtol=1e-4, atol=1e-5)
        assert np.abs(expected[~rows] - chunks[~rows]).max() > 0.1
    assert 0.1 < measure(run.policy, found, num_steps=2).hold.mean < 10  # by each one's spread
    file = tmp_path / "renamed.toml"  # which stands for the cache
    file.write_text(f'path = "{run.recordings.path}"\n[cameras]\nside = "side"\nwrist = "wrist"\n')
    for source in (run.recordings, open_source(file)):
        for name, numbers in (("near", [0, 1, 2]), ("far", [3, 4, 5]), ("", [*range(6)])):
            assert episodes_of(source, name) == numbers
        again = windows(source, run.held_out, run.policy, every=5)
        np.testing.assert_array_equal(again.raw.dataset, which)


def test_the_run_says_what_it_learns_from(run, tmp_path):
    printed = run.console.file.getvalue()
    count = run.steps.num_starts
    far = int((run.steps.dataset[run.steps.starts] == 1).sum())
    assert f"75.0 % of the windows from near: 2 episodes, {count - far} windows" in printed
    assert "warning: far" not in printed
    assert "cameras side\n" in printed
    assert re.search(r"acts for near .*--dataset", printed)
    facts = read_json(run.folder / "dataset.json")["facts"]["datasets"]
    assert facts[1] == {"name": "far", "episodes": 3, "windows": far, "share": 0.25}
    write_json(run.folder / "config.json", to_json(run.config))
    (run.folder / "metrics.jsonl").write_text('{"step": 2, "task": 0.5}\n')
    page = write_report(run.folder).read_text()
    (run.folder / "metrics.jsonl").unlink()
    assert "far.toml" in page
    assert re.search(rf"<td>far</td>.*>3</td>.*>{far}</td>.*>25\.0 %</td>", page)


def test_other_units_and_robots_are_said(sources, tmp_path, monkeypatch):
    degrees = dataclasses.replace(recorded(1, 57.3), robot="so101")
    rlds.write(degrees, tmp_path / "degrees")
    both = config((sources[0], str(tmp_path / "degrees")), statistics="shared")
    printed = prepare(tmp_path, monkeypatch, "", config=both).console.file.getvalue()
    said = [line for line in printed.splitlines() if line.startswith("warning: ")]
    assert not any(line.startswith("warning: near: joint angles") for line in said)
    joints, gripper, robots = (line for line in said if not line.startswith("warning: near"))
    assert joints.startswith("warning: degrees: joint angles reach ")
    assert joints.endswith("add --angles degrees to lorasp-jax inspect --save")
    assert gripper.startswith("warning: degrees: the gripper opens to ")
    assert "the robots are piper + so101: their joints must have the same order" in robots
    (tmp_path / "alone").mkdir()
    alone = config((str(tmp_path / "degrees"),), statistics="shared")
    printed = prepare(tmp_path / "alone", monkeypatch, "", config=alone).console.file.getvalue()
    assert "warning: joint angles reach " in printed


def test_a_gripper_in_percent_is_learned_like_another(tmp_path, monkeypatch):
    """Training sees the same numbers, and the policy acts in percent."""
    seen, acts = [], []
    for unit in (1.0, 100.0):
        scale, group = np.array([*6 * [1], unit], np.float32), recorded(0, 1.0)
        scaled = {name: scale * getattr(group, name) for name in ("state", "action")}
        rlds.write(dataclasses.replace(group, **scaled), tmp_path / f"{unit}")
        own = config((str(tmp_path / f"{unit}"),), statistics="shared")
        (tmp_path / f"run{unit}").mkdir()
        run = prepare(tmp_path / f"run{unit}", monkeypatch, "", config=own)
        raw = draw(jax.random.key(1), jax.device_put(run.steps), batch_size=8, chunk=4)
        seen.append(encode(jax.random.key(2), raw, run.policy.processor, state_noise=0.1))
        acts.append(run.policy.processor.decode(seen[0].actions, raw.state) / scale)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), *seen)
    np.testing.assert_allclose(*acts, atol=1e-5)


def test_a_dataset_that_was_changed_and_restored_is_read_again(sources, tmp_path, monkeypatch):
    folder, source = tmp_path / "run", tmp_path / "near"
    folder.mkdir()
    shutil.copytree(sources[0], source)
    own = config((str(source),), statistics="shared")
    steps = prepare(folder, monkeypatch, "", config=own).steps
    shutil.rmtree(folder / CACHE)
    shutil.move(source, tmp_path / "original")
    rlds.write(recorded(5, 1.0), source)
    with pytest.raises(ValueError, match="dataset differs"):
        prepare(folder, monkeypatch, "", config=own)
    shutil.rmtree(source)
    shutil.move(tmp_path / "original", source)
    again = prepare(folder, monkeypatch, "", config=own)
    jax.tree.map(np.testing.assert_array_equal, again.steps, steps)


def test_it_resumes_to_the_bit_also_streamed(run, sources, tmp_path, monkeypatch):
    for streams in (False, True):
        kept = []
        for name in ("whole", "halved"):
            folder = tmp_path / f"{name}{streams}"
            folder.mkdir()
            one = dataclasses.replace(run, folder=folder, streams=streams)
            one.devices, one.policy = jax.devices()[:1], run.policy
            one.programs = run.programs
            write_json(folder / "config.json", to_json(run.config))
            if name == "whole":
                train(one)
            else:
                with pytest.raises(KeyboardInterrupt):
                    train(one, [Terminate()])
                train(one, resume=True)
            kept.append(leaves(adaptation.split(one.policy.model)[1]))
        for name, value in kept[0].items():
            np.testing.assert_array_equal(kept[1][name], value)
    again = prepare(run.folder, monkeypatch, "", config=config(sources, weights=(3.0, 1.0)))
    jax.tree.map(np.testing.assert_array_equal, again.steps, run.steps)
    jax.tree.map(np.testing.assert_array_equal, again.policy.processor, run.policy.processor)
    with pytest.raises(ValueError, match="dataset differs"):
        prepare(run.folder, monkeypatch, "", config=config(sources, weights=(2.0, 1.0)))


def test_batches_on_two_devices_are_those_of_one(run):
    batches = []
    for count in (1, 2):
        mesh = meshes.make_mesh(1, jax.devices()[:count])
        steps = jax.device_put(run.steps, meshes.replicated(mesh))
        batches.append(DrawnBatches(steps, mesh, 8, 4).take(jax.random.key(0), 3, 2))
    jax.tree.map(np.testing.assert_array_equal, *batches)


def test_shapes_known_before_are_those_of_the_run(run, sources, tmp_path, monkeypatch):
    """As a dry run compiles them, from the sources and from the cache."""
    for folder in (tmp_path, run.folder):
        source = dataset.open_dataset(run.config, Pi0Config.dummy(), folder)
        built = setup.RunSetup(
            *(run.policy.model, "", run.policy.model, run.policy.processor.prompts, 6, (), source),
            *(setup.preflight.Memory(*6 * [0.0]), 2.0**40, 2.0**40),
        )
        blank = early._blank_processor(run.config, built)
        assert jax.tree.structure(blank) == jax.tree.structure(run.policy.processor)
        _, shapes = early.data_shapes(run, built)
        assert shapes.dataset.shape == (2, 8)


def test_an_exported_policy_acts_for_the_dataset_that_is_named(run, tmp_path, capsys):
    models.save(tmp_path / "weights", random_backbone(Pi0Config.dummy()))
    model = dataclasses.replace(run.config.model, checkpoint=str(tmp_path / "weights"))
    one = dataclasses.replace(
        run, folder=tmp_path, config=dataclasses.replace(run.config, model=model)
    )
    one.policy, one.base_hash = run.policy, models.weights_hash(tmp_path / "weights")
    export.write(one)
    assert export.datasets(export.describe(tmp_path)) == ["near", "far"]
    for name, wanted in (("", "near"), ("far", "far")):
        found = load_run(str(tmp_path), dataset=name).policy.processor
        assert f"acts for {wanted}; --dataset chooses" in capsys.readouterr().err
        expected = run.policy.processor.of_dataset(wanted).statistics
        jax.tree.map(np.testing.assert_array_equal, found.statistics, expected)
        assert found.datasets is None
        assert [camera for _, camera in found.cameras if camera] == CAMERAS[wanted]
    with pytest.raises(ValueError, match="acts for near, far, not for 'other'"):
        export.load_policy(tmp_path, dataset="other")


def test_shared_statistics_are_those_of_all(sources, tmp_path, monkeypatch):
    found = prepare(tmp_path, monkeypatch, "", config=config(sources, statistics="shared"))
    processor = found.policy.processor
    slots = np.array(processor.state_slots)
    rows = np.concatenate([next(iter(learned(found, name))) for name in NAMES])
    np.testing.assert_allclose(processor.statistics.state["mean"][slots], rows.mean(0), atol=1e-5)
    assert found.steps.mixture is None
    described = export._metadata(found)["policy"]  # robots may still have other cameras
    assert [*described["cameras"].values()] == ["side", "wrist"]
    assert described["dataset"] == ""
    for name in NAMES:
        own = described["datasets"][name]
        assert [*own["cameras"].values()] == CAMERAS[name]
        assert own["statistics"] == described["statistics"]
    state = jnp.asarray(rows[:4])
    alike = processor.of_rows(jnp.array([0, 1, 0, 1])).normalize_state(state)
    np.testing.assert_allclose(alike, processor.normalize_state(state), atol=1e-6)


def test_the_last_dataset_is_replayed(sources, tmp_path, monkeypatch):
    """With its share, and none of its episodes are held out."""
    data = {"replay": 0.02, "validation": ("1",)}
    found = prepare(tmp_path, monkeypatch, "", config=config(sources, **data))
    np.testing.assert_allclose(found.steps.mixture.shares, [0.98, 0.02])
    assert max(found.held_out) < 3
    three = dataclasses.replace(found.steps, dataset=np.arange(42) // 14, mixture=None, starts=None)
    for weights, shares in (((3.0, 1.0), [0.675, 0.225, 0.1]), ((), [0.45, 0.45, 0.1])):
        options = DataConfig(("a", "b", "c"), weights=weights, replay=0.1)
        np.testing.assert_allclose(dataset.mixed(three, options).mixture.shares, shares, rtol=1e-6)


@pytest.mark.parametrize(
    ("data", "inputs", "sentence"),
    [
        ({"weights": (1.0,)}, {}, "weights needs a number for each dataset, got 1; .* near, far"),
        ({"weights": (1.0, 1.0), "replay": 0.1}, {}, "each dataset but the last, got 2"),
        ({"cameras": ("wrist",)}, {}, "wrist and far side: name the same"),
        ({}, {"masks_missing": False}, "far has no camera wrist, .*--data.cameras side"),
    ],
)
def test_settings_that_do_not_fit(data, inputs, sentence, sources, tmp_path):
    model = Pi0Config.dummy()
    model = dataclasses.replace(model, inputs=dataclasses.replace(model.inputs, **inputs))
    with pytest.raises(ValueError, match=sentence):
        dataset.open_dataset(config(sources, **data), model, tmp_path)


def test_a_dataset_without_the_chosen_cameras_is_refused_in_a_cache_too(run, sources):
    chosen = config(sources, cameras=("wrist",))
    with pytest.raises(ValueError, match=r"far has none of --data\.cameras wrist"):
        dataset.open_dataset(chosen, Pi0Config.dummy(), run.folder)


def test_on_the_command_line_and_in_the_file_of_a_run():
    command = ["--config", f"{ROOT}/configs/multitask.py", "--scale", "smoke"]
    options = ["--data.source", "a", "b", "--data.weights", "2", "1", "--data.statistics", "each"]
    data = parse([*command, *options]).config.data
    assert (data.source, data.weights, data.statistics) == (("a", "b"), (2.0, 1.0), "each")
    written = to_json(dataclasses.replace(CONFIG, data=data))["data"]
    assert (written["source"], written["weights"]) == (["a", "b"], [2.0, 1.0])
    for one in ("a", ("a",)):  # as it was when there was only one
        written = to_json(dataclasses.replace(CONFIG, data=DataConfig(one)))["data"]
        assert written["source"] == "a"
        assert not {"weights", "statistics", "replay"} & written.keys()
    assert to_json(dataclasses.replace(CONFIG, data=DataConfig("")))["data"]["source"] == ""
    assert DataConfig(["a", "b"]).source == ("a", "b")
    with pytest.raises(ValueError, match="source must be"):
        DataConfig(Path("a"))
    for wrong in ({"weights": (0.0,)}, {"replay": 1.0}, {"statistics": "none"}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            DataConfig("a", **wrong)
    for alone in ({"weights": (1.0,)}, {"statistics": "each"}):
        with pytest.raises(ValueError, match=r"data\.source"):
            DataConfig(**alone)


BUNDLED = dataclasses.replace(CONFIG.model, checkpoint="assets/pi0_nano")
REPLAY = dataclasses.replace(
    CONFIG, tasks=("press",), robot="panda", model=BUNDLED, data=DataConfig(replay=0.1)
)


def test_tasks_of_a_base_are_replayed(tmp_path):
    """They are collected with those of the run, but neither evaluated nor a config's tasks."""
    others = ("open_pot", "pour", "pick_place")
    assert replayed_tasks(REPLAY) == others
    run = Run(REPLAY, tmp_path, Console(quiet=True), "")
    seen = []

    def collect(config, folder, report):
        seen.extend(config.tasks)
        return {task: random_episodes(task, i) for i, task in enumerate(config.tasks)}

    phrases = 4 * ["press the button", "push the button"]
    run.episodes = setup._collect(run, phrases, collect)
    assert tuple(seen) == ("press", *others)
    bounds, shares = run.steps.mixture
    assert (bounds.tolist(), shares.tolist()) == ([0, 21, 84], pytest.approx([0.9, 0.1]))
    again = start.with_data(REPLAY, tmp_path, Pi0Config.dummy(), collect)
    assert [*again.episodes] == ["press", *others]
    assert again.steps.mixture.bounds.tolist() == bounds.tolist()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"robot": "piper"}, "was taught open_pot, pour, .* by panda, not by piper"),
        (
            {"model": CONFIG.model},
            r"base \(random\) was taught.* name that of the base last",
        ),
        ({"tasks": ("press", "pour", "open_pot", "pick_place")}, "no other tasks"),
    ],
)
def test_what_cannot_be_replayed(changes, sentence):
    with pytest.raises(ValueError, match=sentence):
        replayed_tasks(dataclasses.replace(REPLAY, **changes))
    with pytest.raises(ValueError, match=r"fresh_every .* data\.replay"):
        DataConfig(replay=0.1, fresh_every=50)


def test_a_run_that_replays_tasks_of_its_base_is_compiled_to_fit(tmp_path, monkeypatch):
    """From shapes alone, without the base, which says what it was taught."""
    seen = []
    monkeypatch.setattr(fit, "ranked", lambda *_: iter([(REPLAY, 0.0)]))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(fit, "planned_bytes", lambda _: {})
    step = None, 0, lambda: None
    monkeypatch.setattr(fit, "plan_step", lambda config, *_: seen.append(config) or step)
    assert fit.fitted(REPLAY, "8GB", (), tmp_path, Console(quiet=True)) is REPLAY
    assert replayed_tasks(seen[0]) == ()
