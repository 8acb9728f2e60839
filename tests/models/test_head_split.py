"""Kernels of equal size with different heads are different models: every layout rejects them."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import safetensors.numpy
from flax import nnx

from lorasp_jax import models
from lorasp_jax.models.checkpoints import published
from lorasp_jax.models.pi0 import Pi0Config, openpi_lora
from lorasp_jax.models.smolvla import SmolVLAConfig
from tests.models.random_models import random_backbone

CONFIG = Pi0Config.dummy()


def with_heads(tower, **heads):
    """The dummy config with other heads but equal kernel sizes; both experts change together."""
    towers = ("vision",) if tower == "vision" else ("language", "action")
    sizes = {name: dataclasses.replace(getattr(CONFIG, name), **heads) for name in towers}
    return dataclasses.replace(CONFIG, **sizes)


OTHERS = {
    "vision": with_heads("vision", heads=4),
    "experts": with_heads("experts", heads=2, kv_heads=1, head_dim=32),
}


@pytest.fixture(scope="module")
def model():
    return random_backbone(CONFIG)


@pytest.fixture(scope="module")
def saved(model, tmp_path_factory):
    """The model's folder in each published layout."""
    folder = tmp_path_factory.mktemp("saved")
    for layout in ("openpi", "lerobot"):
        published.save(folder / layout, model, layout)
    return folder


OPENPI = {
    **{name: (config, r"is \(2, .*, expected \(2, ") for name, config in OTHERS.items()},
    # The image has 2 x 2 patches of 16 pixels; 4 x 4 patches of 8 would need more positions.
    "patches": (
        dataclasses.replace(CONFIG, vision=dataclasses.replace(CONFIG.vision, patch=8)),
        r"img/embedding/kernel of .* \(16, 16, 3, 32\)",
    ),
    "published": (None, r"expected \(14, .*published pi0"),
}


@pytest.mark.parametrize("name", OPENPI)
def test_openpi(name, saved):
    config, message = OPENPI[name]
    with pytest.raises(ValueError, match=message):
        models.load(saved / "openpi", config)


def test_openpi_lora(model):
    """LoRA pairs have head axes, too."""
    size, rank, leaves = CONFIG.language, 2, {}
    for name, kernel in {
        "attn/q_einsum/": (size.heads, size.width, size.head_dim),
        "attn/kv_einsum/": (2, size.kv_heads, size.width, size.head_dim),
        "attn/attn_vec_einsum/": (size.heads, size.head_dim, size.width),
        "mlp/gating_einsum_": (2, size.width, size.mlp),
        "mlp/linear_": (size.mlp, size.width),
    }.items():
        for side, shape in (("a", (*kernel[:-1], rank)), ("b", (*kernel[:-2], rank, kernel[-1]))):
            path = f"PaliGemma/llm/layers/{name}lora_{side}"
            leaves[path] = np.ones((size.depth, *shape), np.float32)
    assert openpi_lora.attach(model, leaves).language.blocks.q_proj.adapter is not None
    other = nnx.eval_shape(lambda: OTHERS["experts"].create(nnx.Rngs(0)))
    with pytest.raises(ValueError, match=r"q_einsum/lora_a .* \(2, 2, 48, 32"):
        openpi_lora.attach(other, leaves)


def test_lerobot_patches(saved, tmp_path):
    tensors = safetensors.numpy.load_file(saved / "lerobot" / "model.safetensors")
    name = next(name for name in tensors if name.endswith("patch_embedding.weight"))
    tensors[name] = tensors[name].reshape(32, 12, 8, 8)
    safetensors.numpy.save_file(tensors, tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match=r"\(32, 12, 8, 8\), expected \(32, 3, 16, 16\)"):
        models.load(tmp_path, CONFIG)


@pytest.mark.parametrize("tower", OTHERS)
def test_lerobot_heads_must_match_config_json(tower, saved, tmp_path, monkeypatch):
    """LeRobot's matrices have no head axes."""
    monkeypatch.setattr(Pi0Config, "base", lambda: CONFIG)
    shutil.copy(saved / "lerobot" / "model.safetensors", tmp_path)
    assert models.load(tmp_path, OTHERS[tower]).config == OTHERS[tower]
    variants = {"paligemma_variant": "gemma_2b", "action_expert_variant": "gemma_300m"}
    (tmp_path / "config.json").write_text(json.dumps({"type": "pi0", **variants}))
    assert models.load(tmp_path, CONFIG).config == CONFIG
    with pytest.raises(ValueError, match="heads"):
        models.load(tmp_path, OTHERS[tower])


@pytest.mark.parametrize("tower", OTHERS)
def test_native_hash_covers_the_config(tower, model, tmp_path):
    models.save(tmp_path, model)
    with pytest.raises(ValueError, match="does not match the config: "):
        models.load(tmp_path, OTHERS[tower])
    path = tmp_path / "config.json"
    fields = json.loads(path.read_text())
    fields["config"] |= json.loads(json.dumps(dataclasses.asdict(OTHERS[tower])))
    path.write_text(json.dumps(fields))
    with pytest.raises(ValueError, match="hash"):
        models.load(tmp_path)


UNRELATED_CONFIGS = [
    ({"architectures": ["SmolVLMForConditionalGeneration"]}, "config.json with sizes"),
    ({"type": "pi0"}, r"lacks .*sizes are those of config\.json"),
    ({"type": "smolvla", "num_vlm_layers": "x"}, "num_vlm_layers"),
    *[({"type": "smolvla", "num_vlm_layers": bad}, "depth|num_vlm") for bad in (1e30, 10**9)],
    ({"type": "smolvla", "chunk_size": 1.5}, "chunk"),
    ({"type": "smolvla", "expert_width_multiplier": 1e400}, "expert_width_multiplier"),
]


def test_smolvla_with_an_unrelated_config(tmp_path):
    config = SmolVLAConfig.dummy()
    published.save(tmp_path, random_backbone(config), "lerobot")
    with pytest.raises(ValueError, match="has weights, but no config"):
        models.load(tmp_path)
    for fields, message in UNRELATED_CONFIGS:
        (tmp_path / "config.json").write_text(json.dumps(fields))
        with pytest.raises(ValueError, match=message):
            models.load(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps({"type": "pi0"}))
    with pytest.raises(ValueError, match=r"Pi0Config .*, got SmolVLAConfig"):
        models.load(tmp_path, config)
