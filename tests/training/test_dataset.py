"""Runs on a dataset: preparation from the command line, and exact streaming from files."""

import dataclasses
import io
import json
import time

import jax
import numpy as np
from rich.console import Console

from envs.datasets import rlds
from lorasp_jax.config import DataConfig, ModelConfig
from lorasp_jax.data import cache
from lorasp_jax.data.batches import flatten, sample_batch
from lorasp_jax.data.opening import open_source
from lorasp_jax.evaluation.callback import NoEvaluation
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig
from lorasp_jax.peft import LoRA
from lorasp_jax.report.html import write_report
from lorasp_jax.training import export, setup
from lorasp_jax.training.base import base_model
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.run_folder import to_json, write_json
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, Miniature, make_run, random_episodes


def prepare(folder, monkeypatch, source, available=2**40, model_config=None, config=None):
    model = random_backbone(model_config or Pi0Config.dummy())
    monkeypatch.setattr(preflight, "available_bytes", lambda: available)
    remat = "none", preflight.Memory(*6 * [0.0])
    monkeypatch.setattr(preflight, "choose_remat", lambda *_: remat)
    evaluation = dataclasses.replace(CONFIG.evaluation, execute_steps=1)
    data, method = (
        DataConfig(source=str(source)),
        {"peft": LoRA(rank=4), "targets": ("action_out",)},
    )
    config = config or dataclasses.replace(CONFIG, data=data, evaluation=evaluation)
    config = dataclasses.replace(config, **method)
    console = Console(file=io.StringIO(), width=200)
    monkeypatch.setattr(setup, "base_model", lambda *_, **__: (model, ""))
    return setup.prepare(config, folder, console, time.perf_counter())


def test_prepare(tmp_path, monkeypatch):
    group = random_episodes("press", 0)
    rlds.write(group, tmp_path / "rlds")
    run = prepare(tmp_path, monkeypatch, tmp_path / "rlds")
    assert (run.config.tasks, run.config.robot, run.simulated) == (("press",), "piper", True)
    assert not run.streams
    slots = [slot for slot, _ in run.policy.processor.cameras]
    summary = f"cameras: side -> {slots[0]}, wrist -> {slots[1]}; resized to "
    assert summary in run.console.file.getvalue()
    assert "named like a wrist camera" not in run.console.file.getvalue()
    expected = flatten([group])
    for name in ("state", "action", "end", "instruction"):
        np.testing.assert_array_equal(getattr(run.steps, name), getattr(expected, name))
    known = run.policy.processor.statistics.action
    slots = np.array(run.policy.processor.action_slots)
    np.testing.assert_allclose(known["mean"][slots], expected.action.mean(0), atol=1e-6)
    small = 2**21
    assert not prepare(tmp_path, monkeypatch, "removed, but cached", small).streams
    (tmp_path / "dataset.json").unlink()
    assert prepare(tmp_path, monkeypatch, "removed, but cached", small // 64).streams
    assert prepare(tmp_path, monkeypatch, "removed, but cached", small).streams  # as at the start


def test_an_export_says_what_numbers_are(tmp_path, monkeypatch):
    """Of simulated episodes names and units; of recordings the names, if they have any."""
    group = random_episodes("press", 0)
    rlds.write(group, tmp_path / "rlds")
    simulated = export._metadata(prepare(tmp_path / "a", monkeypatch, tmp_path / "rlds"))
    assert simulated["names"]["state"] == [*(f"joint_{n}" for n in range(1, 7)), "gripper"]
    assert simulated["units"]["action"] == [*(6 * ["rad"]), "m"]
    rlds.write(dataclasses.replace(group, physics_dt=0.0), tmp_path / "real")
    unnamed = export._metadata(prepare(tmp_path / "b", monkeypatch, tmp_path / "real"))
    assert not {"names", "units"} & unnamed.keys()
    source = open_source(tmp_path / "real")
    source.names = {kind: [*"abcdefg"] for kind in ("state", "action")}
    cache.write([source], tmp_path / "named", lambda *_: None)
    (tmp_path / "c").mkdir()
    named = export._metadata(prepare(tmp_path / "c", monkeypatch, tmp_path / "named"))
    assert named["names"] == source.names
    assert "units" not in named


def test_a_wrist_camera_in_the_place_of_another_is_noticed(tmp_path, monkeypatch):
    group = random_episodes("press", 0)
    image = {"hand": group.image["wrist"], "top": group.image["side"]}
    rlds.write(dataclasses.replace(group, image=image), tmp_path / "rlds")
    run = prepare(tmp_path, monkeypatch, tmp_path / "rlds")
    assert "hand is named like a wrist camera" in run.console.file.getvalue()


def test_actions_of_a_recording_may_be_shorter_than_its_states(tmp_path, monkeypatch):
    """Through a cache, training's batches, and the files of a run."""
    group = random_episodes("press", 0)
    longer = np.concatenate([group.state, group.state[..., :1]], axis=-1)
    recorded = dataclasses.replace(group, state=longer, physics_dt=0.0)
    rlds.write(recorded, tmp_path / "rlds")
    run = prepare(tmp_path / "run", monkeypatch, tmp_path / "rlds")
    processor = run.policy.processor
    assert (processor.state_slots, processor.action_slots) == (
        (0, 1, 2, 3, 4, 5, 6, 7),
        (0, 1, 2, 3, 4, 5, 7),
    )
    steps = run.steps
    assert (steps.state.shape[1], steps.action.shape[1]) == (8, 7)
    batch = sample_batch(
        jax.random.key(0), steps, processor, batch_size=4, chunk=4, state_noise=0.0
    )
    assert not batch.action_mask[..., 6].any()
    found = processor.decode(batch.actions)
    assert found.shape == (4, 4, 7)
    export.write(run)
    loaded = export._processor(export._metadata(run)["policy"], run.policy.model.config, words="")
    assert loaded.action_slots == processor.action_slots
    np.testing.assert_array_equal(
        loaded.normalize_state(longer[0]), processor.normalize_state(longer[0])
    )


def test_published_smolvla_is_trimmed_to_the_cameras_of_the_dataset(tmp_path, monkeypatch):
    """It has three, and its weights expect no image of a missing one."""
    options = ModelConfig("smolvla", size="base", checkpoint="")
    config = dataclasses.replace(CONFIG, model=options, data=DataConfig(source="recorded"))
    simulated = dataclasses.replace(config, data=DataConfig())
    whole, two = (base_model(c, abstract=True)[0].config for c in (config, simulated))
    assert (len(whole.cameras), len(two.cameras)) == (3, 2)
    dummy = SmolVLAConfig.dummy()
    inputs = dataclasses.replace(dummy.inputs, masks_missing=False)
    dummy = dataclasses.replace(dummy, cameras=whole.cameras, inputs=inputs)
    group = random_episodes("press", 0)
    for names in (("side",), ("side", "top", "wrist")):
        images = {name: group.image["side"] for name in names}
        path = tmp_path / f"{len(names)}"
        rlds.write(dataclasses.replace(group, image=images), path)
        run = prepare(tmp_path / f"run{len(names)}", monkeypatch, path, model_config=dummy)
        slots = zip(whole.cameras, names, strict=False)
        assert run.policy.processor.cameras == tuple(slots)


def test_a_run_without_simulation_has_a_report(tmp_path):
    run = make_run(tmp_path / "run", dataclasses.replace(CONFIG, targets=("inp",)), Miniature())
    with run.timed("train"):
        pass
    write_json(run.folder / "config.json", to_json(run.config))
    row = {"step": 2, "task": 0.5, "active_rank/vision": 3}
    (run.folder / "metrics.jsonl").write_text(json.dumps(row) + "\n")
    NoEvaluation().on_end(run)
    found = json.loads((run.folder / "results.json").read_text())
    assert found["tasks"] == found["active_rank"] == {}
    assert found["trainable_parameters"] > 0
    page = write_report(run.folder).read_text()
    assert "Training" in page
    assert "Active rank" in page
    assert "Success" not in page
    assert "sees and does" not in page
