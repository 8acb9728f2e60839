"""LeRobot's config.json of a policy as a backbone's config.

It says little of the towers' sizes, which are those of the published models, and names them where
they vary (policies/{pi0,smolvla}/configuration_*.py of LeRobot 0.6).
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.inputs import LEROBOT_CENTRED
from lorasp_jax.models.pi0.config import Pi0Config
from lorasp_jax.models.smolvla.config import SmolVLAConfig

Fields = Mapping[str, Any]
_IMAGES = ("observation.images.", "observation.")
_MODES = {
    "MEAN_STD": "mean_std",
    "MIN_MAX": "min_max",
    "QUANTILES": "quantiles",
    "IDENTITY": "identity",
}
# What this project's backbones do, and LeRobot's may do otherwise.
_FIXED: Fields = {
    "min_period": 4e-3,
    "max_period": 4.0,
    "attention_mode": "cross_attn",
    "self_attn_every_n_layers": 2,
    "add_image_special_tokens": False,
    "adapt_to_pi_aloha": False,
}


def config_of(fields: Fields) -> BackboneConfig:
    """The config of a policy of LeRobot's; what the fields leave out is as published.

    Args:
        fields: its config.json.

    Raises:
        ValueError: a type that is not pi0 or smolvla, or something that no config here can say.
    """
    kind = str(fields.get("type"))
    if kind not in _KINDS:
        raise ValueError(f"a policy of type {kind!r} is not one of {', '.join(_KINDS)}")
    for name, only in _FIXED.items():
        if fields.get(name, only) != only:
            raise ValueError(f"{name} must be {only!r} here, not {fields[name]!r}")
    try:
        config = _KINDS[kind](fields)
        return dataclasses.replace(config, **_shared(config, fields))
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(f"it is not as LeRobot writes it ({error!r})") from error


def _shared(config: BackboneConfig, fields: Fields) -> dict[str, Any]:
    """What every policy of LeRobot's says."""
    dim, size = config.action_dim, [config.image_size, config.image_size]
    size = fields.get("image_resolution") or fields.get("resize_imgs_with_padding", size)
    dims = {fields.get(f"max_{name}_dim", dim) for name in ("state", "action")}
    if len(dims) > 1 or not size or size[0] != size[1]:
        raise ValueError(
            f"state and action must have one length, pictures be square: {dims}, {size}"
        )
    modes = {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}
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
            config.inputs, state=_MODES[modes["STATE"]], action=_MODES[modes["ACTION"]]
        ),
    }


def _cameras(fields: Fields) -> tuple[str, ...]:
    """Names of the pictures without LeRobot's prefix, those that are always missing last."""
    found = []
    for key, feature in (fields.get("input_features") or {}).items():
        if feature["type"] == "VISUAL":
            prefix = next((p for p in _IMAGES if key.startswith(p)), "")
            found.append(key.removeprefix(prefix))
    empty = [f"empty_camera_{i}" for i in range(fields.get("empty_cameras", 0))]
    return tuple(dict.fromkeys([*found, *empty]))


def _pi0(fields: Fields) -> Pi0Config:
    config = Pi0Config.base()
    sizes = {"gemma_2b": config.language, "gemma_300m": config.action}
    return dataclasses.replace(
        config,
        language=sizes[fields.get("paligemma_variant", "gemma_2b")],
        action=sizes[fields.get("action_expert_variant", "gemma_300m")],
        inputs=LEROBOT_CENTRED,
    )


def _smolvla(fields: Fields) -> SmolVLAConfig:
    config = SmolVLAConfig.base()
    depth = fields.get("num_vlm_layers", config.language.depth)
    if fields.get("num_expert_layers", -1) not in {-1, 0, depth}:
        raise ValueError(f"num_expert_layers must be that of the language model, {depth}")
    action = config.action
    if "expert_width_multiplier" in fields:
        width = int(config.language.width * fields["expert_width_multiplier"])
        # Two thirds of four times the width, in whole 256s (smolvlm_with_expert.py).
        mlp = 256 * math.ceil(4 * int(2 * width / 3) / 256)
        action = dataclasses.replace(action, width=width, mlp=mlp)
    return dataclasses.replace(
        config,
        language=dataclasses.replace(config.language, depth=depth),
        action=dataclasses.replace(action, depth=depth),
    )


_KINDS: Mapping[str, Callable[[Fields], BackboneConfig]] = {"pi0": _pi0, "smolvla": _smolvla}
