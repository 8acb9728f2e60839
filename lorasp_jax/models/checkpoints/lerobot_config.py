"""LeRobot's config.json of a policy as a backbone's config.

The package of a backbone has a module `lerobot` with `TYPES`: a policy's type -> function of the
file's fields that gives a config with the towers' sizes. What all policies share is read here.
"""

import dataclasses
import importlib
from collections.abc import Callable, Mapping
from typing import Any, get_args

from lorasp_jax.models import backbone
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.inputs import Mode

Fields = Mapping[str, Any]
_IMAGES = ("observation.images.", "observation.")
_FOREIGN = (AttributeError, KeyError, OverflowError, TypeError)
_MODES = {mode.upper(): mode for mode in get_args(Mode)}
# What this project's backbones do, and LeRobot's may do otherwise.
_FIXED: Fields = {"min_period": 4e-3, "max_period": 4.0, "adapt_to_pi_aloha": False}


def config_of(fields: Fields) -> BackboneConfig:
    """The config of a policy of LeRobot's; what the fields leave out is as published.

    Args:
        fields: its config.json.

    Raises:
        ValueError: a type that no backbone has, or something that no config here can say.
    """
    config = towers_of(fields)
    require(fields, _FIXED)
    try:
        return dataclasses.replace(config, **_shared(config, fields))
    except _FOREIGN as error:
        raise ValueError(f"it is not as LeRobot writes it ({error!r})") from error


def towers_of(fields: Fields) -> BackboneConfig:
    """A config with the policy's towers; all but these is as published.

    Raises:
        ValueError: a type that no backbone has, or towers that no config here can say.
    """
    kind, types = str(fields.get("type")), _types()
    if kind not in types:
        raise ValueError(f"a policy of type {kind!r} is not one of {', '.join(types)}")
    try:
        return types[kind](fields)
    except _FOREIGN as error:
        raise ValueError(f"it is not as LeRobot writes it ({error!r})") from error


def require(fields: Fields, fixed: Fields) -> None:
    """Raise ValueError where a policy does something else than is fixed here."""
    for name, only in fixed.items():
        if fields.get(name, only) != only:
            raise ValueError(f"{name} must be {only!r} here, not {fields[name]!r}")


def _types() -> dict[str, Callable[[Fields], BackboneConfig]]:
    found = {}
    for name in backbone.names():
        package = backbone.find(name).__module__.rpartition(".")[0]
        found |= importlib.import_module(f"{package}.lerobot").TYPES
    return found


def _shared(config: BackboneConfig, fields: Fields) -> dict[str, Any]:
    """What every policy of LeRobot's says."""
    dim, size = config.action_dim, [config.image_size, config.image_size]
    size = fields.get("image_resolution") or fields.get("resize_imgs_with_padding", size)
    dims = {fields.get(f"max_{name}_dim", dim) for name in ("state", "action")}
    if len(dims) > 1 or not size or size[0] != size[1]:
        raise ValueError(
            f"state and action must have one length, pictures be square: {dims}, {size}"
        )
    inputs = config.inputs
    modes = {"VISUAL": "IDENTITY", "STATE": inputs.state.upper(), "ACTION": inputs.action.upper()}
    modes |= fields.get("normalization_mapping", {})
    if modes["VISUAL"] != "IDENTITY" or not modes.keys() <= {"VISUAL", "STATE", "ACTION"}:
        raise ValueError(f"pictures are not normalised here, but normalization_mapping is {modes}")
    if unknown := sorted(set(modes.values()) - _MODES.keys()):
        raise ValueError(f"normalisation {unknown[0]!r} is not one of {', '.join(_MODES)}")
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
        ),
    }


def _delta(fields: Fields) -> tuple[bool, ...]:
    """Which actions are relative: but those with an excluded word in their name, where they have
    names (processor/relative_action_processor.py of 0.6)."""
    if not fields.get("use_relative_actions"):
        return ()
    size = fields["output_features"]["action"]["shape"][0]
    words = [word.lower() for word in fields.get("relative_exclude_joints", ["gripper"])]
    names = (fields.get("action_feature_names") or [])[:size]
    relative = [not any(word in name.lower() for word in words) for name in names]
    return (*relative, *[True] * (size - len(relative)))


def _cameras(fields: Fields) -> tuple[str, ...]:
    """Names of the pictures without LeRobot's prefix, those that are always missing last."""
    found = []
    for key, feature in (fields.get("input_features") or {}).items():
        if feature["type"] == "VISUAL":
            prefix = next((p for p in _IMAGES if key.startswith(p)), "")
            found.append(key.removeprefix(prefix))
    empty = [f"empty_camera_{i}" for i in range(fields.get("empty_cameras", 0))]
    return tuple(dict.fromkeys([*found, *empty]))
