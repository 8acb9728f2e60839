"""A base is adapted with the chunk, prompts, relative actions and units of its training."""

import dataclasses
import io
import json
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from envs.datasets import rlds
from lorasp_jax import models
from lorasp_jax.config import DataConfig, ModelConfig
from lorasp_jax.models import inputs
from lorasp_jax.models.checkpoints import loading, published
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.peft import LoRA
from lorasp_jax.policies import aloha
from lorasp_jax.policies.prompt_table import PromptTable
from lorasp_jax.policies.tokenizer import Offline
from lorasp_jax.training import base, export, setup
from lorasp_jax.training.cost import preflight
from lorasp_jax.training.loop import train
from lorasp_jax.training.overrides import override
from lorasp_jax.training.relative import for_robot
from lorasp_jax.training.run_folder import to_json
from tests.models.random_models import random_backbone
from tests.runs import CONFIG, random_episodes

ARM = (*[True] * 6, False)


@pytest.fixture
def weightless(monkeypatch):
    """Checkpoints load as their config alone."""
    load = lambda _, config: SimpleNamespace(config=config)  # noqa: E731
    monkeypatch.setattr(loading.ModelFolder, "load", load)
    monkeypatch.setattr(models, "weights_hash", lambda _: "")


def folder_of_openpi(folder, chunk=None):
    """Make a folder look like a checkpoint of openpi, or with a chunk, like its conversion."""
    folder.mkdir()
    if chunk is None:
        (folder / "params").mkdir()
        (folder / "params" / "_METADATA").write_text("{}")
    else:
        (folder / "model.safetensors").write_bytes(b"")
        fields = {"action_dim": 32, "action_horizon": chunk}
        (folder / "config.json").write_text(json.dumps(fields))
    return folder


def found(where, *options, size="base_pi05"):
    """Return the config of the base that a run with these options has."""
    config = dataclasses.replace(CONFIG, model=ModelConfig(size=size, checkpoint=str(where)))
    return base.base_model(override(config, options))[0].config


@pytest.mark.usefixtures("weightless")
def test_a_folder_named_after_a_training_config_is_trained_as_it_was(tmp_path, capsys):
    folder = folder_of_openpi(tmp_path / "pi05_libero")
    expected = dataclasses.replace(inputs.OPENPI_PI05, prompt_state=False)
    assert (found(folder).chunk, found(folder).inputs) == (10, expected)
    line = capsys.readouterr().err.splitlines()[0]
    assert all(text in line for text in ("pi05_libero", "chunks of 10", "without the state"))
    droid = found(folder, "--model.openpi-config", "pi05_full_droid_finetune")
    assert (droid.chunk, droid.inputs.prompt_state) == (16, True)
    assert droid.inputs.delta == (*[True] * 7, False)
    plain = found(folder, "--model.openpi-config", "none")
    assert (plain.chunk, plain.inputs) == (50, inputs.OPENPI_PI05)
    assert not capsys.readouterr().err  # what is given needs no line
    recorded = folder_of_openpi(tmp_path / "torch", chunk=30)
    assert found(recorded, "--model.openpi-config", "pi05_libero").chunk == 30


@pytest.mark.usefixtures("weightless")
def test_nothing_is_assumed_in_silence(tmp_path, capsys):
    folder = folder_of_openpi(tmp_path / "mine")
    assert found(folder).chunk == 50
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    texts = (str(folder), "chunks of 50", "absolute actions", "state in prompts")
    assert all(text in line for text in (*texts, "--model.openpi-config"))
    found(folder, "--model.chunk", "10", "--model.relative-actions", "False", size="base")
    assert not capsys.readouterr().err
    found(folder_of_openpi(tmp_path / "torch", chunk=30))
    assert "chunks" not in capsys.readouterr().err


@pytest.mark.usefixtures("weightless")
@pytest.mark.parametrize(
    ("fields", "backbone", "size"),
    [
        ({"type": "smolvla"}, "smolvla", "base"),
        ({"type": "pi0"}, "pi0", "base"),
        ({"type": "pi05"}, "pi0", "base_pi05"),
    ],
)
def test_a_policy_of_lerobot_is_trained_with_its_chunk(fields, backbone, size, tmp_path, capsys):
    def chunk(fields, *options):
        (tmp_path / "config.json").write_text(json.dumps(fields))
        return found(tmp_path, "--model.backbone", backbone, *options, size=size).chunk

    (tmp_path / "model.safetensors").write_bytes(b"")
    recorded = fields | {"chunk_size": 13, "n_action_steps": 7}
    assert chunk(recorded) == 13
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert all(text in line for text in (str(tmp_path), "chunks of 13", "--model.chunk"))
    chunk(recorded, "--model.chunk", "6")  # `setup.build` takes what is given
    assert chunk(fields) == 50
    assert not capsys.readouterr().err


@pytest.mark.usefixtures("weightless")
def test_configs_that_do_not_fit_are_refused(tmp_path):
    folder = folder_of_openpi(tmp_path / "pi05_libero")
    with pytest.raises(ValueError, match=r"of pi0\.5: .* base_pi05"):
        found(folder, size="base")
    with pytest.raises(ValueError, match="unknown training config 'pi05_x'"):
        found(folder, "--model.openpi-config", "pi05_x")
    with pytest.raises(ValueError, match="assets/pi0_nano is none"):
        found("assets/pi0_nano", "--model.openpi-config", "pi0_libero", size="nano")


def test_a_dry_run_without_the_files_follows_the_name(capsys):
    config = dataclasses.replace(
        CONFIG, model=ModelConfig(size="nano_pi05", checkpoint="gs://bucket/pi05_libero")
    )
    model, _ = base.base_model(config, abstract=True)
    assert (model.config.chunk, model.config.inputs.prompt_state) == (10, False)
    assert "pi05_libero" in capsys.readouterr().err
    random = ModelConfig(size="nano_pi05", checkpoint="", openpi_config="pi05_droid")
    model, _ = base.base_model(dataclasses.replace(CONFIG, model=random), abstract=True)
    assert model.config.chunk == 15


def recordings(state, action, grippers):
    episode = SimpleNamespace(action=np.zeros((1, 1, action)))
    return SimpleNamespace(grippers={"action": grippers}, episode=lambda *_: episode), state - 1


def test_the_mask_of_relative_actions_is_that_of_the_robot():
    """The base's is kept where it fits: LIBERO's states have another number than its actions."""
    libero = dataclasses.replace(inputs.OPENPI, delta=ARM)
    two_arms = recordings(14, 14, [6, 13])
    cases = [
        (None, inputs.OPENPI, recordings(8, 7, [6]), ()),
        (None, libero, recordings(8, 7, [6]), ARM),
        (None, libero, two_arms, (*ARM, *ARM)),
        (True, inputs.OPENPI, two_arms, (*ARM, *ARM)),
        (False, libero, two_arms, ()),
        (None, libero, (None, 5), (*[True] * 5, False)),
    ]
    for wanted, known, robot, mask in cases:
        assert for_robot(known, wanted, *robot).delta == mask
    for wanted, known in ((True, inputs.OPENPI), (None, libero)):
        with pytest.raises(ValueError, match=r"9 and 8: pass --model\.relative-actions False"):
            for_robot(known, wanted, *recordings(9, 8, [7]))


def test_statistics_are_measured_in_the_units_of_the_base():
    """Those of ALOHA, whose grippers stay absolute."""
    known = dataclasses.replace(inputs.OPENPI, aloha=True)
    known = for_robot(known, True, *recordings(14, 14, [13]))
    assert known.delta == (*ARM, *ARM)
    config = dataclasses.replace(Pi0Config.dummy(), inputs=known, action_dim=32)
    group = random_episodes("fold", 0)
    state, action = np.random.default_rng(0).uniform(0.1, 0.9, (2, 3, 9, 14)).astype(np.float32)
    group = dataclasses.replace(group, state=state, action=action, length=np.full(3, 9, np.int32))
    prompts = PromptTable.of(Offline(), group.instructions, config, num_joints=13)
    processor = setup.processor([group], config, prompts)
    statistics, converted = processor.statistics, aloha.state_to_pi0(state)
    np.testing.assert_allclose(statistics.state["mean"][:14], converted.mean((0, 1)), atol=1e-4)
    for gripper in aloha.GRIPPERS:  # not relative
        windows = np.minimum(np.arange(9)[:, None] + np.arange(config.chunk), 8)
        mean = aloha.actions_to_pi0(action)[:, windows, gripper].mean()
        np.testing.assert_allclose(statistics.action["mean"][gripper], mean, atol=1e-4)
    normalized = processor.normalize_actions(jnp.asarray(action), jnp.asarray(state[:, 0]))
    decoded = processor.decode(normalized, jnp.asarray(state[:, 0]))
    np.testing.assert_allclose(decoded, action, atol=1e-4)
    for robot in (recordings(7, 7, [6]), (None, 6)):
        with pytest.raises(ValueError, match=r"ALOHA, .* 14 numbers, not 7 and 7"):
            for_robot(known, None, *robot)


def test_older_runs_resume():
    """Their settings had neither a training config nor a third kind of relative actions."""
    model = to_json(CONFIG)["model"]
    assert model["relative_actions"] is False
    assert "openpi_config" not in model
    named = dataclasses.replace(CONFIG, model=ModelConfig(openpi_config="none"), data=DataConfig())
    assert to_json(named)["model"]["openpi_config"] == "none"


def test_a_checkpoint_of_openpi_trains_and_is_exported(tmp_path, monkeypatch):
    """From a folder named after its training config, on recordings; the given chunk wins."""
    cameras = Pi0Config.base().cameras
    tiny = dataclasses.replace(
        Pi0Config.dummy(), pi05=True, cameras=cameras, action_dim=32, inputs=inputs.OPENPI_PI05
    )
    published.save(tmp_path / "pi05_libero", random_backbone(tiny), "openpi")
    monkeypatch.setattr(Pi0Config, "base_pi05", lambda: dataclasses.replace(tiny))
    remat = "none", preflight.Memory(*6 * [0.0])
    monkeypatch.setattr(preflight, "choose_remat", lambda *_: remat)
    rlds.write(random_episodes("press", 0), tmp_path / "rlds")
    config = dataclasses.replace(
        CONFIG,
        model=ModelConfig(size="base_pi05", checkpoint=str(tmp_path / "pi05_libero")),
        data=DataConfig(source=str(tmp_path / "rlds")),
        evaluation=dataclasses.replace(CONFIG.evaluation, execute_steps=1),
        peft=LoRA(rank=4),
        targets=("action_out",),
    )
    console = Console(file=io.StringIO())
    (tmp_path / "run").mkdir()
    run = setup.prepare(config, tmp_path / "run", console, time.time())
    assert run.policy.model.config.chunk == 10
    assert run.policy.processor.prompts.numbers is None  # no state in prompts
    run.devices = jax.devices()[:1]
    train(run)
    export.write(run)
    policy = export.load_policy(tmp_path / "run")
    expected = dataclasses.replace(inputs.OPENPI_PI05, prompt_state=False)
    assert (policy.model.config.chunk, policy.processor.inputs) == (10, expected)
    shorter = override(config, ["--model.chunk", "6"])
    assert setup.build(shorter, tmp_path / "other").base.config.chunk == 6
