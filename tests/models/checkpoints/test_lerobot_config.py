import dataclasses
import json

import pytest

from lorasp_jax.models.checkpoints import loading
from lorasp_jax.models.checkpoints.lerobot_config import parse
from lorasp_jax.models.inputs import LEROBOT_PI0, LEROBOT_PI05, LEROBOT_SMOLVLA
from lorasp_jax.models.pi0 import Pi0Config
from lorasp_jax.models.smolvla import SmolVLAConfig

SMOLVLA = {
    "type": "smolvla",
    "chunk_size": 50,
    "max_state_dim": 32,
    "max_action_dim": 32,
    "resize_imgs_with_padding": [512, 512],
    "tokenizer_max_length": 48,
    "num_vlm_layers": 16,
    "num_expert_layers": 0,
    "expert_width_multiplier": 0.75,
    "self_attn_every_n_layers": 2,
    "attention_mode": "cross_attn",
    "add_image_special_tokens": False,
    "normalization_mapping": {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"},
    "input_features": {
        "observation.state": {"type": "STATE", "shape": [6]},
        **{
            f"observation.images.camera{i}": {"type": "VISUAL", "shape": [3, 256, 256]}
            for i in (1, 2, 3)
        },
    },
}
MAPPINGS = [{"STATE": "QUANTILE5"}, {"VISUAL": "MEAN_STD"}, {"OTHER": "MEAN_STD"}]


def test_published_fields_give_the_published_config():
    assert parse(SMOLVLA) == SmolVLAConfig.base()
    assert parse({"type": "smolvla"}) == SmolVLAConfig.base()
    expected = dataclasses.replace(Pi0Config.base(), inputs=LEROBOT_PI0)
    assert parse({"type": "pi0", "image_resolution": [224, 224]}) == expected
    expected = dataclasses.replace(Pi0Config.base_pi05(), inputs=LEROBOT_PI05)
    assert parse({"type": "pi05", "tokenizer_max_length": 200}) == expected
    assert (expected.inputs.state, expected.inputs.action) == ("quantiles", "quantiles")


def test_other_fields_override_the_published_config():
    features = {
        "observation.images.top": {"type": "VISUAL"},
        "observation.image": {"type": "VISUAL"},
    }
    config = parse(
        SMOLVLA
        | {
            "chunk_size": 10,
            "max_state_dim": 24,
            "max_action_dim": 24,
            "tokenizer_max_length": 20,
            "resize_imgs_with_padding": [256, 256],
            "num_vlm_layers": 8,
            "expert_width_multiplier": 0.5,
            "input_features": features,
            "empty_cameras": 1,
            "normalization_mapping": {"STATE": "QUANTILE10", "ACTION": "MIN_MAX"},
        }
    )
    assert (config.chunk, config.action_dim, config.max_tokens, config.image_size) == (
        10,
        24,
        20,
        256,
    )
    assert (config.language.depth, config.action.depth) == (8, 8)
    # 2/3 of 4 * 480 = 1280, a multiple of 256.
    assert (config.language.width, config.action.width, config.action.mlp) == (960, 480, 1280)
    assert config.cameras == ("top", "image", "empty_camera_0")
    assert config.inputs == dataclasses.replace(
        LEROBOT_SMOLVLA, state="quantile10", action="min_max"
    )
    large = parse({"type": "pi0", "action_expert_variant": "gemma_2b"})
    assert large.action == large.language


@pytest.mark.parametrize(
    ("names", "exclusion", "relative"),
    [
        (["j1.pos", "Gripper.pos", "j2.pos"], {}, (True, False, True)),
        (["j1.pos", "Gripper.pos", "j2.pos"], {"relative_exclude_joints": []}, (True,) * 3),
        (["gripper"], {"relative_exclude_joints": ["j2", "GRIP"]}, (False, True, True)),
        (None, {}, (True,) * 3),
    ],
)
def test_relative_actions(names, exclusion, relative):
    """Actions whose name contains an excluded word are absolute; unnamed actions are relative."""
    fields = {"type": "pi0", "output_features": {"action": {"type": "ACTION", "shape": [3]}}}
    fields |= {"use_relative_actions": True, "action_feature_names": names, **exclusion}
    config = parse(fields)
    assert config.inputs.delta == relative
    assert parse(fields | {"use_relative_actions": False}).inputs.delta == ()
    assert Pi0Config.from_dict(json.loads(json.dumps(dataclasses.asdict(config)))) == config


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"type": "act"}, "'act'"),
        ({"attention_mode": "self_attn"}, "attention_mode"),
        ({"max_state_dim": 7}, "dimensions"),
        *[({"resize_imgs_with_padding": size}, "square") for size in ([512, 256], None)],
        *[({"normalization_mapping": bad}, "normalization") for bad in MAPPINGS],
        ({"use_relative_actions": True}, "output_features"),
        ({"type": "pi05", "use_visual_memory": True}, "use_visual_memory"),
        ({"num_expert_layers": 8}, "num_expert_layers"),
    ],
)
def test_unsupported_fields_raise(change, name):
    with pytest.raises((ValueError, KeyError), match=name):
        parse(SMOLVLA | change)


PREPROCESSOR = {
    "rename_observations_processor": {
        "rename_map": {"observation.images.front": "observation.images.base_0_rgb"}
    },
    "pi05_prepare_state_tokenizer_processor_step": {"max_state_dim": 32},
    "relative_actions_processor": {
        "enabled": True,
        "exclude_joints": ["gripper"],
        "action_names": ["j1.pos", "gripper.pos"],
    },
    "normalizer_processor": {"eps": 1e-8, "norm_map": {"STATE": "MIN_MAX", "ACTION": "MEAN_STD"}},
    "tokenizer_processor": {"max_length": 90},
}


def pi05_folder(folder, changes, without=()):
    """A pi0.5 policy without weights; its config.json says other things than its preprocessor."""
    features = {f"observation.images.{name}": {"type": "VISUAL"} for name in ("base_0_rgb", "top")}
    fields = {"type": "pi05", "input_features": features, "empty_cameras": 1}
    fields |= {"output_features": {"action": {"type": "ACTION", "shape": [2]}}}
    (folder / "config.json").write_text(json.dumps(fields))
    steps = [
        {"registry_name": name, "config": config | changes.get(name, {})}
        for name, config in PREPROCESSOR.items()
        if name not in without
    ]
    (folder / "policy_preprocessor.json").write_text(json.dumps({"steps": steps}))
    return loading.find(folder)


def test_the_preprocessor_wins(tmp_path):
    """LeRobot runs the steps that policy_preprocessor.json lists."""
    found = pi05_folder(tmp_path, {})
    inputs = dataclasses.replace(LEROBOT_PI05, state="min_max", action="mean_std")
    assert found.config.inputs == dataclasses.replace(inputs, delta=(True, False))
    assert found.config.max_tokens == 90
    assert found.config.cameras == ("base_0_rgb", "top", "empty_camera_0")
    assert found.robot_cameras == {"base_0_rgb": "front", "top": "top"}


def test_a_pipeline_without_the_state_has_prompts_without_it(tmp_path):
    without = ("pi05_prepare_state_tokenizer_processor_step", "relative_actions_processor")
    inputs = pi05_folder(tmp_path, {}, without).config.inputs
    assert (inputs.prompt_state, inputs.delta) == (False, ())


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"use_relative_actions": "false"}, "use_relative_actions must be true or false"),
        ({"relative_exclude_joints": "gripper"}, "relative_exclude_joints must be a list"),
        ({"input_features": {"a": None}}, "input_features.a must be an object"),
        ({"expert_width_multiplier": "0.75"}, "expert_width_multiplier must be a number"),
        ({"empty_cameras": 10**9}, "empty_cameras must be at most 100"),
        ({"type": "pi0", "paligemma_variant": "gemma_9b"}, "paligemma_variant must be one of"),
    ],
)
def test_fields_of_the_wrong_type_are_named(change, name, tmp_path):
    (tmp_path / "config.json").write_text(json.dumps(SMOLVLA | change))
    (tmp_path / "model.safetensors").touch()
    with pytest.raises(ValueError, match=rf"config\.json is damaged .{name}"):
        loading.load_config(tmp_path)


@pytest.mark.parametrize(
    ("step", "change", "name"),
    [
        ("normalizer_processor", {"eps": 1e-3}, "eps"),
        ("normalizer_processor", {"norm_map": {"STATE": "QUANTILE5"}}, "normalization"),
        (
            "pi05_prepare_state_tokenizer_processor_step",
            {"include_state_in_prompt": False},
            "include_state_in_prompt",
        ),
        ("rename_observations_processor", {"rename_map": ["front"]}, r"preprocessor\.json"),
    ],
)
def test_unsupported_steps_raise(step, change, name, tmp_path):
    def read():
        found = pi05_folder(tmp_path, {step: change})
        return found.config, found.robot_cameras

    with pytest.raises(ValueError, match=name):
        read()
