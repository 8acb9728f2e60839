"""LeRobot's PEFT adapters of its policies, with the modules that it adapts by default."""

import dataclasses
import json
import re

import numpy as np
import pytest
import safetensors.numpy
from flax import nnx

import lorasp_jax
from lorasp_jax import models
from lorasp_jax.adapters.io import hugging_face
from lorasp_jax.dense import AdapterParam, Dense
from lorasp_jax.models.checkpoints import published
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig
from tests.adapters.io.peft_folder import edit_config, edit_tensors

PROJECTIONS = (
    "state_proj",
    *("action_in_proj", "action_out_proj", "action_time_mlp_in", "action_time_mlp_out"),
)
EXPERTS = {
    "pi0": "paligemma_with_expert.gemma_expert.model",
    "pi05": "paligemma_with_expert.gemma_expert.model",
    "smolvla": "vlm_with_expert.lm_expert",
}
"""Module of the action expert in policies/{pi0,pi05,smolvla} of LeRobot 0.6."""
CONFIGS = {
    "pi0": Pi0Config.dummy(),
    "pi05": dataclasses.replace(Pi0Config.dummy(), pi05=True),
    "smolvla": SmolVLAConfig.dummy(),
}


def create(policy):
    return CONFIGS[policy].create(nnx.Rngs(0))


def layers(model, policy):
    """Layer and index in its stack of each module that LeRobot adapts.

    These are the action expert's queries and values, and the projections. SmolVLA's layers
    alternate between self-attention and cross-attention.
    """
    blocks, found = model.action.blocks, {}
    for i in range(model.config.action.depth):
        stack, index = blocks, i
        if policy == "smolvla":
            stack, index = (blocks.self_layer, blocks.cross_layer)[i % 2], i // 2
        for name in ("q_proj", "v_proj"):
            found[f"{EXPERTS[policy]}.layers.{i}.self_attn.{name}"] = getattr(stack, name), (index,)
    present = [name for name in PROJECTIONS if hasattr(model, name)]  # pi0.5 has two of them
    return found | {name: (getattr(model, name), ()) for name in present}


def write(folder, model, policy):
    """Write an adapter as LeRobot does; return what it adds to each kernel [I, O]."""
    rng, tensors, updates = np.random.default_rng(0), {}, {}
    for module, (layer, _) in layers(model, policy).items():
        a, b = (rng.normal(size=(2, n)).astype(np.float32) for n in layer.kernel.shape[-2:])
        prefix = f"base_model.model.model.{module}.lora_"
        tensors |= {f"{prefix}A.weight": a, f"{prefix}B.weight": np.ascontiguousarray(b.T)}
        updates[module] = 2 * a.T @ b
    safetensors.numpy.save_file(tensors, folder / hugging_face.TENSORS)
    config = {"peft_type": "LORA", "r": 2, "lora_alpha": 4, "modules_to_save": []}
    (folder / hugging_face.CONFIG).write_text(json.dumps(config))
    return updates


@pytest.mark.parametrize("policy", EXPERTS)
def test_adapters_of_lerobot(policy, tmp_path):
    model = create(policy)
    names, updates = models.lerobot_names(model), write(tmp_path, model, policy)
    loaded = lorasp_jax.load_peft(tmp_path, model, names=names)
    for module, (layer, index) in layers(loaded, policy).items():
        a, b = (np.asarray(layer.adapter.get_value()[name][index]) for name in ("lora_a", "lora_b"))
        np.testing.assert_allclose(layer.method.scale * a @ b, updates[module], atol=1e-5)
    assert lorasp_jax.count(loaded).trainable == sum(2 * sum(u.shape) for u in updates.values())
    lorasp_jax.save_peft(tmp_path / "again", loaded, names=names)
    saved, written = (
        safetensors.numpy.load_file(folder / hugging_face.TENSORS)
        for folder in (tmp_path / "again", tmp_path)
    )
    assert saved.keys() == written.keys()


@pytest.mark.parametrize("policy", EXPERTS)
def test_names_are_those_of_the_published_tensors(policy, tmp_path):
    """target_modules and full_training_modules can name any layer of a policy."""
    model = create(policy)
    names, found = models.lerobot_names(model), set()
    for path, layer in nnx.iter_modules(model):
        if isinstance(layer, Dense):
            for index in np.ndindex(layer.stack_shape()):
                found.add(names("/".join(map(str, path)), index) + ".weight")
    published.save(tmp_path, model, "lerobot")
    tensors = safetensors.numpy.load_file(tmp_path / "model.safetensors")
    matrices = {name for name, tensor in tensors.items() if tensor.ndim > 1}
    tables = {name for name in matrices if re.search(r"embed_tokens|position_emb|lm_head", name)}
    assert found == matrices - tables


def test_full_training_modules(tmp_path):
    """LeRobot's option; the module is stored in full instead of an adapter."""
    model = create("smolvla")
    write(tmp_path, model, "smolvla")
    d_in, d_out = model.state_proj.kernel.shape
    prefix = "base_model.model.model.state_proj"
    value = np.arange(d_in * d_out, dtype=np.float32).reshape(d_out, d_in)

    def trained_in_full(tensors):
        others = {name: array for name, array in tensors.items() if prefix not in name}
        return others | {f"{prefix}.weight": value, f"{prefix}.bias": value[:, 0].copy()}

    edit_tensors(tmp_path, trained_in_full)
    edit_config(tmp_path, modules_to_save=["state_proj"])
    loaded = lorasp_jax.load_peft(tmp_path, model, names=models.lerobot_names(model))
    np.testing.assert_array_equal(loaded.state_proj.kernel[...], value.T)
    assert isinstance(loaded.state_proj.kernel, AdapterParam)


def test_a_part_of_a_backbone(tmp_path):
    model = create("pi0")
    write(tmp_path, model, "pi0")
    with pytest.raises(ValueError, match="blocks/down_proj is no layer of the backbone"):
        lorasp_jax.load_peft(tmp_path, model.action, names=models.lerobot_names(model))
