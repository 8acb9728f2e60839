"""Which pi0 a config.json of LeRobot's means (policies/pi0 and policies/pi05 of 0.6)."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from lorasp_jax.models.checkpoints.lerobot_config import require
from lorasp_jax.models.inputs import LEROBOT_CENTRED, LEROBOT_PI05
from lorasp_jax.models.pi0.pi0 import Pi0Config


def pi0(fields: Mapping[str, Any]) -> Pi0Config:
    """The published sizes, each expert in one of the two that there are."""
    config = Pi0Config.base()
    sizes = {"gemma_2b": config.language, "gemma_300m": config.action}
    return dataclasses.replace(
        config,
        language=sizes[fields.get("paligemma_variant", "gemma_2b")],
        action=sizes[fields.get("action_expert_variant", "gemma_300m")],
        inputs=LEROBOT_CENTRED,
    )


def pi05(fields: Mapping[str, Any]) -> Pi0Config:
    """pi0.5 with the same choice.

    Raises:
        ValueError: it remembers past observations.
    """
    require(fields, {"use_visual_memory": False, "use_proprioceptive_memory": False})
    config = Pi0Config.base_pi05()
    return dataclasses.replace(
        pi0(fields), pi05=True, max_tokens=config.max_tokens, inputs=LEROBOT_PI05
    )


TYPES = {"pi0": pi0, "pi05": pi05}
"""Function of a config.json that gives the config, by the policy's type."""
