"""`load` for every layout; the published sizes are replaced by those of the golden models."""

import dataclasses
import json
import logging
import shutil

import huggingface_hub
import numpy as np
import pytest
import safetensors.numpy

from lorasp_jax import models
from lorasp_jax.models.checkpoints import loading, published
from lorasp_jax.models.checkpoints.native import named_arrays
from lorasp_jax.models.inputs import OPENPI, OPENPI_PI05
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig
from tests.models import test_pi0_parity as pi0
from tests.models import test_smolvla_parity as smolvla
from tests.models.random_models import random_backbone

FIELDS = {
    "type": "smolvla",
    "chunk_size": smolvla.CONFIG.chunk,
    "tokenizer_max_length": smolvla.CONFIG.max_tokens,
    "resize_imgs_with_padding": [smolvla.CONFIG.image_size] * 2,
    "input_features": {f"observation.images.{i}": {"type": "VISUAL"} for i in (0, 1)},
}


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    """Use the golden models' towers as the published ones, which config.json does not specify."""
    monkeypatch.setattr(Pi0Config, "base", lambda: pi0.CONFIG)
    monkeypatch.setattr(SmolVLAConfig, "base", lambda: smolvla.CONFIG)


@pytest.fixture
def lerobot(tmp_path):
    """A policy folder in the old format of `lerobot/smolvla_base`: statistics among the weights."""
    folder = tmp_path / "policy"
    folder.mkdir()
    tensors = safetensors.numpy.load_file(smolvla.GOLDEN / "model.safetensors")
    tensors = {name.replace("model.", "model._orig_mod.", 1): a for name, a in tensors.items()}
    for name in ("so100_buffer_observation_state", "buffer_observation_images_camera1"):
        tensors[f"normalize_inputs.{name}.mean"] = np.zeros(6, np.float32)
    safetensors.numpy.save_file(tensors, folder / "model.safetensors")
    (folder / "config.json").write_text(json.dumps(FIELDS))
    return folder


def assert_same(actual, expected):
    actual, expected = named_arrays(actual), named_arrays(expected)
    assert actual.keys() == expected.keys()
    for name, array in actual.items():
        np.testing.assert_array_equal(array, expected[name], err_msg=name)


def test_lerobot(lerobot, caplog):
    with caplog.at_level(logging.INFO):
        model = models.load(lerobot)
    assert "skipped unused tensors normalize_inputs." in caplog.text
    assert model.config == models.load_config(lerobot) == smolvla.CONFIG
    assert_same(model, published.load_published(smolvla.GOLDEN, smolvla.CONFIG)[0])
    (lerobot / "config.json").unlink()
    assert_same(models.load(lerobot, smolvla.CONFIG), model)
    with pytest.raises(ValueError, match=r"config\.json"):
        models.load(lerobot)


def test_a_config_overrides_the_sizes_in_config_json(tmp_path):
    config = Pi0Config.dummy()
    published.save(tmp_path / "dummy", random_backbone(config), "lerobot")
    (tmp_path / "dummy" / "config.json").write_text('{"type": "pi0"}')
    with pytest.raises(ValueError, match="pass a config"):
        models.load(tmp_path / "dummy")
    assert models.load(tmp_path / "dummy", config).config == config


def test_config_json_is_read_once(lerobot):
    folder = loading.find(lerobot)
    assert (folder.layout, folder.config) == ("lerobot", smolvla.CONFIG)
    (lerobot / "config.json").unlink()
    assert folder.inputs == smolvla.CONFIG.inputs
    assert folder.load().config == smolvla.CONFIG


def test_lerobot_without_config_json(lerobot):
    (lerobot / "config.json").unlink()
    folder = loading.find(lerobot)
    assert (folder.layout, folder.inputs) == ("lerobot", None)
    with pytest.raises(ValueError, match="pass a config"):
        _ = folder.config


def test_openpi(tmp_path):
    folder = tmp_path / "29999"
    shutil.copytree(pi0.GOLDEN / "orbax", folder)
    model = models.load(folder)
    assert model.config == models.load_config(folder) == pi0.CONFIG
    assert loading.find(folder).layout == "openpi"
    assert_same(model, published.load_published(folder / "params", pi0.CONFIG)[0])


def test_single_files_win_as_in_the_projects_that_own_the_layouts(tmp_path):
    """Over shards in Transformers and LeRobot, over `params` in openpi."""
    model = random_backbone(Pi0Config.dummy())
    for layout in ("lerobot", "openpi"):
        published.save(tmp_path, model, layout)
    tensors = safetensors.numpy.load_file(tmp_path / "model.safetensors")
    changed = {name: array + 1 for name, array in tensors.items()}
    safetensors.numpy.save_file(changed, tmp_path / "model-00001-of-00001.safetensors")
    shards = dict.fromkeys(tensors, "model-00001-of-00001.safetensors")
    (tmp_path / "model.safetensors.index.json").write_text(json.dumps({"weight_map": shards}))
    assert_same(models.load(tmp_path, model.config), model)
    safetensors.numpy.save_file(changed, tmp_path / "model.safetensors")
    loaded = models.load(tmp_path, model.config)
    np.testing.assert_array_equal(loaded.state_proj.bias[...], model.state_proj.bias[...] + 1)


@pytest.mark.parametrize("pi05", [False, True])
def test_conversions_of_openpi(pi05, tmp_path, monkeypatch):
    """No prefix in the names; chunk and action length are in config.json, pi05 in the names."""
    config = dataclasses.replace(pi0.CONFIG, pi05=pi05, chunk=10)
    monkeypatch.setattr(
        Pi0Config, "base_pi05", lambda: dataclasses.replace(pi0.CONFIG, pi05=True, max_tokens=20)
    )
    model = random_backbone(config)
    published.save(tmp_path, model, "lerobot")
    tensors = safetensors.numpy.load_file(tmp_path / "model.safetensors")
    tensors = {name.removeprefix("model."): array for name, array in tensors.items()}
    safetensors.numpy.save_file(tensors, tmp_path / "model.safetensors")
    fields = {"action_dim": 32, "action_horizon": 10, "paligemma_variant": "gemma_2b"}
    (tmp_path / "config.json").write_text(json.dumps(fields | {"precision": "bfloat16"}))
    loaded = models.load(tmp_path)
    assert_same(loaded, model)
    assert (loaded.config.pi05, loaded.config.chunk) == (pi05, 10)
    assert loaded.config.inputs == (OPENPI_PI05 if pi05 else OPENPI)
    assert loading.find(tmp_path).resized(pi0.CONFIG).chunk == 10
    (tmp_path / "config.json").write_text(json.dumps(fields | {"type": "pi0"}))
    with pytest.raises(ValueError, match="leave out --size"):
        loading.find(tmp_path).resized(pi0.CONFIG)


def test_a_folder_of_several_checkpoints(tmp_path):
    for step in ("5000", "20000", "30000.orbax-checkpoint-tmp-3"):
        shutil.copytree(pi0.GOLDEN / "orbax", tmp_path / "pi0_mine" / "try" / step)
    for where in (tmp_path / "pi0_mine" / "try", tmp_path / "pi0_mine"):
        with pytest.raises(ValueError, match=r"no model itself: .* such as .*/try/20000$"):
            models.load(where, pi0.CONFIG)
    lerobot = tmp_path / "lerobot" / "checkpoints" / "005000" / "pretrained_model"
    lerobot.mkdir(parents=True)
    (lerobot / "model.safetensors").touch()
    with pytest.raises(ValueError, match=r"005000/pretrained_model$"):
        models.load_config(tmp_path / "lerobot")


def test_an_adapter_is_not_a_model(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({**FIELDS, "use_peft": True}))
    (tmp_path / "adapter_config.json").write_text(
        json.dumps({"peft_type": "LORA", "base_model_name_or_path": "lerobot/smolvla_base"})
    )
    expected = f"PEFT adapter of hf://lerobot/smolvla_base, .* --adapter NAME={tmp_path}"
    for load in (models.load, models.load_config, lambda path: models.load(path, smolvla.CONFIG)):
        with pytest.raises(ValueError, match=expected):
            load(tmp_path)


def test_ours_and_the_hub(tmp_path, monkeypatch):
    models.save(tmp_path, models.load(pi0.GOLDEN / "orbax"))
    monkeypatch.setattr(huggingface_hub, "snapshot_download", lambda *_, **__: tmp_path)
    assert models.load_config("hf://me/pi0") == pi0.CONFIG
    assert loading.find("hf://me/pi0").layout == "ours"
    assert models.weights_hash(models.load("hf://me/pi0")) == models.weights_hash(tmp_path)


def test_invalid_folders_raise(lerobot, tmp_path):
    with pytest.raises(ValueError, match="contains no model"):
        models.load(tmp_path)
    with pytest.raises(ValueError, match="no_such"):
        models.load(tmp_path / "no_such")
    (lerobot / "config.json").write_text(json.dumps({**FIELDS, "type": "act"}))
    with pytest.raises(ValueError, match=r"config\.json .* 'act'"):
        models.load(lerobot)
    for text in ("{", "[]"):
        (lerobot / "config.json").write_text(text)
        with pytest.raises(ValueError, match=r"config\.json is damaged"):
            models.load(lerobot)
