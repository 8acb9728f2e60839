"""`load` for every layout; the published sizes are replaced by those of the golden models."""

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
