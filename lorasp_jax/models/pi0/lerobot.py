"""Convert the config.json of a LeRobot 0.6 pi0 or pi0.5 policy (policies/pi0, policies/pi05).

Also that of openpi's PyTorch conversions (examples/convert_jax_model_to_pytorch.py at 15a9616),
whose tensors have the same names.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

from lorasp_jax.models.checkpoints.lerobot_config import require
from lorasp_jax.models.config import BackboneConfig
from lorasp_jax.models.inputs import LEROBOT_PI0, LEROBOT_PI05, OPENPI, OPENPI_PI05
from lorasp_jax.models.pi0.pi0 import Pi0Config


def pi0_config(fields: Mapping[str, Any]) -> Pi0Config:
    """Return a config with the published sizes of the Gemma variants that the fields name."""
    config = Pi0Config.base()
    sizes = {"gemma_2b": config.language, "gemma_300m": config.action}

    def size(field: str, default: str) -> Any:
        if (variant := fields.get(field, default)) not in [*sizes]:
            raise ValueError(f"{field} must be one of {', '.join(sizes)}, got {variant!r}")
        return sizes[variant]

    language, action = (
        size("paligemma_variant", "gemma_2b"),
        size("action_expert_variant", "gemma_300m"),
    )
    return dataclasses.replace(config, language=language, action=action, inputs=LEROBOT_PI0)


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


def is_conversion(fields: Mapping[str, Any]) -> bool:
    """Whether the fields are those of openpi's PyTorch conversion."""
    return "type" not in fields and "action_horizon" in fields


def conversion_config(fields: Mapping[str, Any], *, pi05: bool) -> BackboneConfig:
    """Like `pi0_config`, for openpi's PyTorch conversion, which does not record `pi05`."""
    config = (pi05_config if pi05 else pi0_config)(fields)
    config = dataclasses.replace(config, inputs=OPENPI_PI05 if pi05 else OPENPI)
    return with_lengths(config, fields)


def with_lengths(config: BackboneConfig, fields: Mapping[str, Any]) -> BackboneConfig:
    """Return a config with the lengths of chunks and actions that a conversion records."""
    return dataclasses.replace(
        config,
        chunk=fields.get("action_horizon", config.chunk),
        action_dim=fields.get("action_dim", config.action_dim),
    )


TYPES = {"pi0": pi0_config, "pi05": pi05_config}
"""Policy type -> function (fields of config.json) -> config."""
