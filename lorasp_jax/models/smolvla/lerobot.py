"""Convert the config.json of a LeRobot 0.6 SmolVLA (policies/smolvla/configuration_smolvla.py)."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from lorasp_jax.models.checkpoints.lerobot_config import require
from lorasp_jax.models.smolvla.smolvla import SmolVLAConfig

# LeRobot options for which this backbone supports only one value.
_FIXED = {
    "attention_mode": "cross_attn",
    "self_attn_every_n_layers": 2,
    "add_image_special_tokens": False,
}


def smolvla_config(fields: Mapping[str, Any]) -> SmolVLAConfig:
    """Return the published config with depth and expert width from the fields.

    Raises:
        ValueError: unsupported attention, special tokens or number of expert layers.
    """
    config = SmolVLAConfig.base()
    depth = fields.get("num_vlm_layers", config.language.depth)
    require(fields, _FIXED)
    if fields.get("num_expert_layers", -1) not in {-1, 0, depth}:
        layers = fields["num_expert_layers"]
        raise ValueError(f"num_expert_layers must equal num_vlm_layers = {depth}, got {layers!r}")
    action = config.action
    if (multiplier := fields.get("expert_width_multiplier")) is not None:
        width = int(config.language.width * multiplier)
        # 2/3 of 4 * width, rounded up to a multiple of 256 (smolvlm_with_expert.py).
        mlp = 256 * math.ceil(4 * int(2 * width / 3) / 256)
        action = dataclasses.replace(action, width=width, mlp=mlp)
    return dataclasses.replace(
        config,
        language=dataclasses.replace(config.language, depth=depth),
        action=dataclasses.replace(action, depth=depth),
    )


TYPES = {"smolvla": smolvla_config}
"""Policy type -> function (fields of config.json) -> config."""
