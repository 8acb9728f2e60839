"""Convert a LeRobot policy's config.json, and its preprocessor, to a backbone config.

Each backbone package has a module `lerobot`, whose `TYPES` maps policy types to functions. They
convert the fields to a config with the tower sizes. Fields that all policies share are read here.

LeRobot runs the steps that policy_preprocessor.json lists, whatever config.json says of them.
"""

import dataclasses
import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, get_args

from lorasp_jax.base import json_values
from lorasp_jax.models import backbone
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.inputs import Mode

Fields = Mapping[str, Any]
_MODES = {mode.upper(): mode for mode in get_args(Mode)}
# LeRobot options for which this project's backbones support only one value.
_FIXED: Fields = {
    "min_period": 4e-3,
    "max_period": 4.0,
    "adapt_to_pi_aloha": False,
    "use_delta_joint_actions_aloha": False,
}
FIELDS: Fields = {
    "type": str,
    "input_features?": {str: {"type": str}},
    "output_features?": {str: {}},
    "normalization_mapping?": {str: str},
    "use_relative_actions?": bool,
    "relative_exclude_joints?": [str],
    "action_feature_names?": [str],
    "image_resolution?": (int, int),
    "resize_imgs_with_padding?": (int, int),
    "empty_cameras?": int,
    "num_vlm_layers?": int,
    "expert_width_multiplier?": float,
}
_OPTIONS: Fields = {
    "norm_map?": {str: str},
    "rename_map?": {str: str},
    "enabled?": bool,
    "exclude_joints?": [str],
    "action_names?": [str],
    "max_length?": int,
}
STEPS: Fields = {"steps": [{"registry_name?": str, "config?": _OPTIONS}]}
"""Schemas of config.json and of its preprocessor, see `json_values.check`."""
PREPROCESSOR = "policy_preprocessor.json"
EMPTY = "empty_camera_"
"""Prefix of the cameras that LeRobot feeds with black images."""
_MAX_CAMERAS = 100
_STATE_PROMPT = "pi05_prepare_state_tokenizer_processor_step"
_IDENTITY = dict.fromkeys(("VISUAL", "STATE", "ACTION"), "IDENTITY")


def parse(fields: Fields) -> BackboneConfig:
    """Convert a LeRobot policy's config; missing fields default to the published values.

    Args:
        fields: contents of config.json.

    Raises:
        ValueError: an unknown policy type or an unsupported option.
        AttributeError, KeyError, OverflowError, TypeError: a field of the wrong type.
    """
    config = parse_towers(fields)
    require(fields, _FIXED)
    return dataclasses.replace(config, **_shared_fields(config, fields))


def preprocessed(fields: Fields, preprocessor: Fields) -> dict[str, Any]:
    """Return a policy's fields with what its preprocessor says in their place.

    Args:
        fields: contents of config.json.
        preprocessor: contents of policy_preprocessor.json (LeRobot 0.6, processor/*.py).

    Returns:
        The fields, also with "rename_map" and "prompt_state", which config.json does not have.

    Raises:
        ValueError: an unsupported option of a step.
        AttributeError, KeyError, TypeError: a value of the wrong type.
    """
    json_values.check(preprocessor, STEPS, nulls=True)
    steps = {s.get("registry_name"): s.get("config") or {} for s in preprocessor["steps"]}
    found: dict[str, Any] = {"prompt_state": _STATE_PROMPT in steps}
    require(steps.get(_STATE_PROMPT, {}), {"include_state_in_prompt": True})
    if relative := steps.get("relative_actions_processor"):
        names = ("enabled", "use_relative_actions"), ("exclude_joints", "relative_exclude_joints")
        names = (*names, ("action_names", "action_feature_names"))
        found |= {field: relative[name] for name, field in names if name in relative}
    if normalizer := steps.get("normalizer_processor"):
        require(normalizer, {"eps": 1e-8})
        if modes := normalizer.get("norm_map"):
            found["normalization_mapping"] = {**_IDENTITY, **modes}
    if renamed := steps.get("rename_observations_processor"):
        found["rename_map"] = renamed["rename_map"]
    if length := steps.get("tokenizer_processor", {}).get("max_length"):
        found["tokenizer_max_length"] = length
    return {**fields, **found}


def robot_cameras(fields: Fields, cameras: Sequence[str]) -> dict[str, str]:
    """Return the policy's cameras but the empty ones, and the robot's names for them."""
    renamed = {_camera(new): _camera(old) for old, new in fields.get("rename_map", {}).items()}
    return {name: renamed.get(name, name) for name in cameras if not name.startswith(EMPTY)}


def parse_towers(fields: Fields) -> BackboneConfig:
    """Convert only the tower sizes; all other fields have the published values.

    Raises:
        ValueError: an unknown policy type or unsupported towers.
    """
    policy, types = str(fields.get("type")), _types()
    if policy not in types:
        raise ValueError(f"type must be one of {', '.join(types)}, got {policy!r}")
    return types[policy](fields)


def require(fields: Fields, supported: Fields) -> None:
    """Raise ValueError if a field has a value other than the supported one."""
    for name, value in supported.items():
        if fields.get(name, value) != value:
            raise ValueError(f"{name} must be {value!r}, got {fields[name]!r}")


def _types() -> dict[str, Callable[[Fields], BackboneConfig]]:
    types: dict[str, Callable[[Fields], BackboneConfig]] = {}
    for name in backbone.names():
        package = backbone.find(name).__module__.rpartition(".")[0]
        types |= importlib.import_module(f"{package}.lerobot").TYPES
    return types


def _shared_fields(config: BackboneConfig, fields: Fields) -> dict[str, Any]:
    """Convert the fields that all LeRobot policies share."""
    dim, size = config.action_dim, [config.image_size, config.image_size]
    size = fields.get("image_resolution") or fields.get("resize_imgs_with_padding", size)
    dims = {fields.get(f"max_{name}_dim", dim) for name in ("state", "action")}
    if len(dims) > 1 or not size or size[0] != size[1]:
        raise ValueError(f"dimensions must be equal and images square, got {dims} and {size}")
    inputs = config.inputs
    modes = {"VISUAL": "IDENTITY", "STATE": inputs.state.upper(), "ACTION": inputs.action.upper()}
    modes |= fields.get("normalization_mapping") or {}
    known = modes.keys() == {"VISUAL", "STATE", "ACTION"} and _MODES.keys() >= {*modes.values()}
    if modes["VISUAL"] != "IDENTITY" or not known:
        raise ValueError(f"normalization_mapping is not supported: {modes}")
    return {
        "cameras": _cameras(fields) or config.cameras,
        "image_size": size[0],
        "max_tokens": fields.get("tokenizer_max_length", config.max_tokens),
        "chunk": fields.get("chunk_size", config.chunk),
        "action_dim": dims.pop(),
        "inputs": dataclasses.replace(
            inputs,
            state=_MODES[modes["STATE"]],
            action=_MODES[modes["ACTION"]],
            delta=_delta(fields),
            prompt_state=fields.get("prompt_state", True) and inputs.prompt_state,
        ),
    }


def _delta(fields: Fields) -> tuple[bool, ...]:
    """Return the mask of relative action dimensions: all whose names contain no excluded word.

    Dimensions without a name are relative, too (LeRobot 0.6,
    processor/relative_action_processor.py).
    """
    if not fields.get("use_relative_actions"):
        return ()
    size = fields["output_features"]["action"]["shape"][0]
    excluded = fields.get("relative_exclude_joints", ["gripper"])
    words = [word.lower() for word in excluded or ()]
    names = (fields.get("action_feature_names") or [])[:size]
    relative = [not any(word in name.lower() for word in words) for name in names]
    return (*relative, *[True] * (size - len(relative)))


def _cameras(fields: Fields) -> tuple[str, ...]:
    """Return the camera names without LeRobot's prefix; placeholder cameras come last."""
    names = []
    for key, feature in (fields.get("input_features") or {}).items():
        if feature["type"] == "VISUAL":
            names.append(_camera(key))
    if (count := fields.get("empty_cameras") or 0) > _MAX_CAMERAS:
        raise ValueError(f"empty_cameras must be at most {_MAX_CAMERAS}, got {count}")
    empty = [f"{EMPTY}{i}" for i in range(count)]
    return tuple(dict.fromkeys([*names, *empty]))


def _camera(key: str) -> str:
    return key.removeprefix("observation.").removeprefix("images.")
