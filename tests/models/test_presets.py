"""Presets: the layers of both backbones that they match, and the resulting parameter counts."""

import dataclasses
import re

import pytest
from flax import nnx

import lorasp_jax
from lorasp_jax.adapters import adaptation, paths, summary
from lorasp_jax.models import pi0, presets, smolvla
from lorasp_jax.peft import FullFineTuning, LoRA, LoRASP

EXPERT = {f"{name}_proj" for name in ("q", "k", "v", "o", "gate", "up", "down")}
BLOCK = {"q_proj", "k_proj", "v_proj", "out_proj", "fc1", "fc2"}
PROJECTIONS = {
    *(f"{name}_proj" for name in ("state", "action_in", "action_out")),
    *(f"action_time_mlp_{name}" for name in ("in", "out")),
}
VISION = {"vision/head", *(f"vision/blocks/{name}" for name in BLOCK)}
PATCH = {"vision/patch_embed"}
LANGUAGE = {f"language/blocks/{name}" for name in EXPERT}
ACTION = {
    pi0: {f"action/blocks/{name}" for name in EXPERT},
    smolvla: {f"action/blocks/{kind}_layer/{n}" for kind in ("self", "cross") for n in EXPERT},
}


def adapted(config, targets, method):
    rules = presets.rules(targets, method)
    return nnx.eval_shape(
        lambda: lorasp_jax.adapt(config.create(nnx.Rngs(0)), rules, rngs=nnx.Rngs(1))
    )


@pytest.mark.parametrize("backbone", [pi0, smolvla], ids=["pi0", "smolvla"])
def test_layers_of_each_preset(backbone):
    """Including stacked layers; the table covers every preset."""
    action = ACTION[backbone]
    expected = {
        "paper": VISION | LANGUAGE | action | PROJECTIONS,
        "all-linear": PATCH | VISION | LANGUAGE | action | PROJECTIONS,
        "openpi": LANGUAGE | action,
        "expert-only": action | PROJECTIONS,
        "vision": PATCH | VISION,
        "language": LANGUAGE,
        "action": action,
        "projections": PROJECTIONS,
    }
    assert expected.keys() == presets.PRESETS.keys()
    root = nnx.List([nnx.eval_shape(lambda: backbone.Config.dummy().create(nnx.Rngs(0)))])
    layers = {location.path for location in paths.locate_layers(root)}
    for name, layer_paths in expected.items():
        rules = presets.patterns(name)
        assert {p for p in layers if any(re.search(rule, p) for rule in rules)} == layer_paths, name
    model = adapted(backbone.Config.dummy(), ["vision", "k_proj$"], LoRASP(rank=4))
    keys = {path for path in layers if path.endswith("/k_proj")}
    assert adaptation.methods(model).keys() == PATCH | VISION | keys


def test_adaptive_norms_are_in_action_but_not_in_openpi():
    config = dataclasses.replace(pi0.Config.dummy(), pi05=True)
    matched = {
        name: adaptation.methods(adapted(config, name, LoRA(rank=2))).keys()
        for name in ("openpi", "action")
    }
    assert matched["openpi"] == LANGUAGE | ACTION[pi0]
    norms = ("blocks/input_layernorm", "blocks/post_attention_layernorm", "norm")
    assert matched["action"] == ACTION[pi0] | {f"action/{name}/dense" for name in norms}


@pytest.mark.parametrize(
    ("config", "adapters", "base", "share"),
    [
        (pi0.Config.base(), 2_213_824 * 128, 3_238_048_528, "8.05%"),
        (smolvla.Config.base(), 670_096 * 128, 450_046_176, "16.01%"),
    ],
    ids=["pi0", "smolvla"],
)
def test_trained_share_of_the_published_sizes(config, adapters, base, share):
    """Adapter parameters: the sum of I + O over linear layers except the lm_heads, times rank."""
    model = adapted(config, "paper", LoRA(rank=128))
    line = summary.trained_share(model)
    assert line.startswith(f"{share} of parameters trainable ({adapters:,} of {adapters + base:,})")


def test_trained_share_lists_frozen_modules():
    """LeRobot's `train_expert_only` trains the same number; without adapters it is 0."""
    config = smolvla.Config.base()
    model = adapted(config, "expert-only", FullFineTuning())
    assert adaptation.count(model).trainable == 99_880_992
    line = "22.19% of parameters trainable (99,880,992 of 450,046,176); entirely frozen: "
    assert summary.trained_share(model) == f"{line}language, vision"
    dummy = smolvla.Config.dummy()
    line = summary.trained_share(adapted(dummy, "all-linear", LoRA(rank=2)))
    assert line.endswith(")")
    line = summary.trained_share(adapted(dummy, ".*", FullFineTuning()))
    assert line.startswith("100.00%")
    assert line.endswith("; nothing is frozen")
    bare = nnx.eval_shape(lambda: dummy.create(nnx.Rngs(0)))
    assert summary.trained_share(bare).startswith("0.00% of parameters trainable (0 of ")


def test_an_unknown_preset_is_refused():
    with pytest.raises(ValueError, match=r"'expert-onyl'.*paper, all-linear"):
        presets.rules(["q_proj", "expert-onyl"], LoRA())


@pytest.mark.parametrize("pattern", ["visio", "action_out", "q_proj"])
def test_substrings_of_paths_are_patterns(pattern):
    assert presets.patterns(pattern) == [pattern]
