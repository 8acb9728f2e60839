"""Which pi0 a config.json of LeRobot's means (policies/pi0/configuration_pi0.py of 0.6)."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from lorasp_jax.models.inputs import LEROBOT_CENTRED
from lorasp_jax.models.pi0.config import Pi0Config


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


TYPES = {"pi0": pi0}
"""Function of a config.json that gives the config, by the policy's type."""
