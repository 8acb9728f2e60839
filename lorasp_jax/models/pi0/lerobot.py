"""Convert the config.json of a LeRobot 0.6 pi0 or pi0.5 policy (policies/pi0, policies/pi05)."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from lorasp_jax.models.checkpoints.lerobot_config import require
from lorasp_jax.models.inputs import LEROBOT_PI0, LEROBOT_PI05
from lorasp_jax.models.pi0.pi0 import Pi0Config


def pi0_config(fields: Mapping[str, Any]) -> Pi0Config:
    """Return a config with the published sizes of the Gemma variants that the fields name."""
    config = Pi0Config.base()
    sizes = {"gemma_2b": config.language, "gemma_300m": config.action}
    return dataclasses.replace(
        config,
        language=sizes[fields.get("paligemma_variant", "gemma_2b")],
        action=sizes[fields.get("action_expert_variant", "gemma_300m")],
        inputs=LEROBOT_PI0,
    )


def pi05_config(fields: Mapping[str, Any]) -> Pi0Config:
    """Like `pi0_config`, but for pi0.5.

    Raises:
        ValueError: the policy uses past observations.
    """
    require(fields, {"use_visual_memory": False, "use_proprioceptive_memory": False})
    config = Pi0Config.base_pi05()
    return dataclasses.replace(
        pi0_config(fields), pi05=True, max_tokens=config.max_tokens, inputs=LEROBOT_PI05
    )


TYPES = {"pi0": pi0_config, "pi05": pi05_config}
"""Policy type -> function (fields of config.json) -> config."""
