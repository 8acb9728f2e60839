"""What a start run decides, and what is refused in one sentence."""

import dataclasses
import re
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from rich.console import Console

from envs import Randomization
from lorasp_jax.adapters import adaptation
from lorasp_jax.cli.train import _resolved
from lorasp_jax.config import ModelConfig
from lorasp_jax.peft import LoRASP
from lorasp_jax.reinforce import command, setting, start
from lorasp_jax.reinforce.config import Learning, ReinforceConfig
from lorasp_jax.training.export import load_policy
from lorasp_jax.training.finished_run import recorded_config
from lorasp_jax.training.overrides import parse
from lorasp_jax.training.run_folder import read_json, to_json, write_json
from tests import ROOT
from tests.reinforce import rooms
from tests.reinforce.rooms import outputs
from tests.runs import CONFIG, RESULTS, finish_with_weights, leaves, write_description

SDE = ["--online.method", "ppo", "--online.exploration", "sde"]
FILE = str(ROOT / "configs/reinforce.py")


@pytest.fixture(scope="module")
def few(tmp_path_factory):
    """A finished run with plain LoRA, whose base is saved beside it."""
    return finish_with_weights(tmp_path_factory.mktemp("runs") / "few")


def resolve(*arguments) -> ReinforceConfig:
    options = ["--config", FILE, "--scale", "smoke", "--evaluation.execute-steps", "2"]
    options += map(str, arguments)
    config = _resolved(parse(options)).config
    assert isinstance(config, ReinforceConfig)
    return config


def test_the_start_run_decides(few):
    config = resolve("--from", few, "--online.std", 0.2)
    recorded = recorded_config(few)
    for name in ("model", "robot", "tasks", "peft", "targets", "image_size"):
        assert getattr(config, name) == getattr(recorded, name), name
    assert (config.online.std, config.name) == (0.2, "reinforce")


def test_another_scene_can_be_learned(few):
    assert not resolve("--from", few).scene.changed()
    scene = resolve("--from", few, "--scene.brightness", 0.9, 1.1).scene
    assert scene.changed() == {"brightness": (0.9, 1.1)}


def test_ranges_of_the_start_stay_unless_given(few, monkeypatch):
    recorded = recorded_config(few)
    ranges = Randomization(brightness=(0.8, 1.0), table_height=(-0.01, 0.01))
    recorded = dataclasses.replace(recorded, scene=ranges)
    monkeypatch.setattr(start, "recorded_config", lambda _: recorded)
    assert resolve("--from", few).scene == ranges
    scene = resolve("--from", few, "--scene.brightness", 0.9, 1.1).scene
    assert scene == dataclasses.replace(ranges, brightness=(0.9, 1.1))


def test_a_run_is_recorded_and_read_again(few, tmp_path):
    config = resolve("--from", few)
    write_json(tmp_path / "config.json", to_json(config))
    write_json(tmp_path / "results.json", RESULTS)
    write_description(tmp_path)
    fields = [f.name for f in dataclasses.fields(CONFIG)]
    recorded = recorded_config(tmp_path)
    for name in fields:
        assert getattr(recorded, name) == getattr(config, name), name


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--robot", "panda"], "--robot is that of .*few \\(piper\\): drop it"),
        (["--model.size", "small"], "--model.size is that of .*few: drop it"),
        (["--peft.rank", 2], "--peft.rank is that of .*few: drop it"),
        (["--tasks", "pour"], "few has learned press, not pour"),
        (["--online.std", 0], "online.std must be above 0, got 0.0"),
        (["--online.worlds", 0], "online.worlds must be at least 1, got 0"),
        (["--online.teacher-worlds", 4], "online.teacher_worlds must be at least 8, got 4"),
        (["--online.epochs", 2], "online.epochs is not for teacher: drop it"),
        (["--online.method", "ppo", "--online.rounds", 2], "online.rounds is not for ppo: drop it"),
        (
            ["--online.method", "ppo", "--optim.steps", 1],
            "optim.steps must be at least 2, got 1: the first iteration",
        ),
        (["--online.exploration", "sde"], "online.exploration sde is for ppo, not for teacher"),
        (["--online.noise-level", 2], "online.noise_level must lie in \\(0, 1\\], got 2.0"),
        (["--online.noise-level", 0.2], "online.noise_level is not for actions: drop it"),
        ([*SDE, "--online.std", 0.2], "online.std is not for sde: drop it"),
        (
            [*SDE, "--evaluation.denoise-steps", 1],
            "evaluation.denoise_steps must be at least 2 for sde, got 1",
        ),
        (["--online.discount", 1.5], "online.discount must lie in \\(0, 1\\], got 1.5"),
        (["--method", "lora"], "--method is that of .*few: drop it"),
        (["--optim.ema", 0.9], "optim.ema is not for reinforcement learning: drop it"),
        (["--optim.warmup-steps", 5], "optim.warmup_steps is not for reinforcement learning"),
        (["--evaluation.no-before"], "evaluation.before is not for reinforcement learning"),
        (["--log-every", 2], "log_every is not for reinforcement learning: drop it"),
        (["--recap.share", 0.5], "recap.share is not for reinforcement learning: drop it"),
        (["--learn", "recap"], "learn is not for reinforcement learning: drop it"),
        (["--keep", "last"], "keep is not for reinforcement learning: drop it"),
        (["--from", "", "--data.source", "x"], "data.source is not for reinforcement learning"),
        (["--optim.spike", 9], "optim.spike is not for reinforcement learning: drop it"),
        (["--dry-run"], "--dry-run is not for reinforcement learning: drop it"),
        (["--fit", "16GB"], "--fit is not for reinforcement learning: drop it"),
    ],
)
def test_bad_input_is_refused_in_a_sentence(few, arguments, message, capsys):
    with pytest.raises((ValueError, SystemExit)) as caught:
        resolve("--from", few, *arguments)
    said = str(caught.value) + re.sub(r"[│\s]+", " ", capsys.readouterr().err)
    assert re.search(message, said), said


def test_runs_without_success_or_end_are_refused(few, tmp_path):
    config = recorded_config(few)
    write_json(tmp_path / "config.json", to_json(config))
    with pytest.raises(ValueError, match="is not a finished run"):
        resolve("--from", tmp_path)
    write_json(tmp_path / "results.json", RESULTS | {"tasks": {}})
    with pytest.raises(ValueError, match=r"the tasks of .* cannot be simulated"):
        resolve("--from", tmp_path)


@pytest.fixture
def changed(few, tmp_path):
    """Copy the run and change what it recorded of its config or policy."""

    def change(policy=(), **config):
        folder = shutil.copytree(few, tmp_path / "changed")
        changed = dataclasses.replace(recorded_config(few), **config)
        write_json(folder / "config.json", to_json(changed))
        found = read_json(folder / "adapter.json")
        found["metadata"]["policy"] |= dict(policy)
        write_json(folder / "adapter.json", {k: v for k, v in found.items() if k != "digest"})
        return folder

    return change


def test_runs_with_several_statistics_are_refused(changed):
    folder = changed(policy={"dataset": "near", "datasets": {"near": {}, "far": {}}})
    with pytest.raises(ValueError, match="for each of near, far: start from a run with one"):
        resolve("--from", folder)


def test_adapters_that_cannot_be_merged_are_refused(changed):
    folder = changed(peft=LoRASP())
    assert resolve("--from", folder).online.adapters == "continue"
    with pytest.raises(ValueError, match=r"\(lora_sp\) cannot be merged: drop --online.adapters"):
        resolve("--from", folder, "--online.adapters", "merge")


def test_adapters_are_not_merged_into_a_quantized_base(changed):
    folder = changed(model=ModelConfig(size="dummy", base_dtype="int8"))
    with pytest.raises(ValueError, match=r"is quantized: drop --online.adapters"):
        resolve("--from", folder, "--online.adapters", "merge")


def load(config, folder):
    folder.mkdir()
    return start.load(config, folder, Console(quiet=True), 0.0)


def test_adapters_go_on_and_are_exported(few, tmp_path):
    run = load(resolve("--from", few), tmp_path / "run")
    np.testing.assert_allclose(outputs(run.policy), outputs(load_policy(few)), atol=1e-5)
    start.PolicyExport().on_end(run)
    again = load_policy(run.folder)
    np.testing.assert_array_equal(outputs(again), outputs(run.policy))


def test_adapters_are_merged_under_new_ones(few, tmp_path):
    config = resolve("--from", few, "--online.adapters", "merge", "--peft.rank", 2)
    run = load(config, tmp_path / "run")
    assert config.peft.rank == 2
    np.testing.assert_allclose(outputs(run.policy), outputs(load_policy(few)), atol=0.05)
    adapters = leaves(adaptation.split(run.policy.model)[1])
    assert any(not leaf.any() for leaf in adapters.values())  # new ones add nothing
    start.PolicyExport().on_end(run)
    np.testing.assert_array_equal(outputs(load_policy(run.folder)), outputs(run.policy))


def test_the_start_is_measured_as_it_acts(few, tmp_path, monkeypatch):
    """A run that learned by recap asks for good actions."""
    asked = []
    monkeypatch.setattr(command, "Evaluation", lambda **given: asked.append(given))
    monkeypatch.setattr(command.loop, "train", lambda *_, **__: None)
    command.run(resolve("--from", few), tmp_path, Console(quiet=True), 0.0, resume=False)
    assert asked == [{"learned": True}]


def test_worlds_that_do_not_fit_are_refused():
    learn = Learning(worlds=2**22)
    with pytest.raises(ValueError, match=r"4194304 worlds .* choose fewer"):
        setting.check_memory(rooms.config(online=learn), {"press": rooms.Room(num_envs=2**22)})


def test_pictures_are_held_twice(monkeypatch):
    once = 2 * 8 * 2 * 32 * 32 * 3 / jax.local_device_count()
    monkeypatch.setattr(setting.preflight, "available_bytes", lambda: 1.5 * once)
    with pytest.raises(ValueError, match="choose fewer worlds"):
        setting.check_memory(rooms.config(), {"press": rooms.Room()})


def test_configs_files_load(tmp_path):
    assert Path(FILE).exists()
    for scale in ("smoke", "cpu", "accelerator"):
        assert parse(["--config", FILE, "--scale", scale]).config.online.worlds
