"""Which SmolVLA a config.json of LeRobot 0.6 means (policies/smolvla/configuration_smolvla.py)."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from lorasp_jax.models.checkpoints.lerobot_config import require
from lorasp_jax.models.smolvla.smolvla import SmolVLAConfig

# What this backbone does, and LeRobot's may do otherwise.
_FIXED = {
    "attention_mode": "cross_attn",
    "self_attn_every_n_layers": 2,
    "add_image_special_tokens": False,
}


def smolvla(fields: Mapping[str, Any]) -> SmolVLAConfig:
    """The published vision tower; as many language layers and as wide an expert as it says.

    Raises:
        ValueError: another kind of attention or of tokens.
    """
    config = SmolVLAConfig.base()
    depth = fields.get("num_vlm_layers", config.language.depth)
    require(fields, _FIXED)
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


TYPES = {"smolvla": smolvla}
"""Function of a config.json that gives the config, by the policy's type."""
