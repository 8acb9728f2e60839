"""SmolVLA: SigLIP, SmolLM2 and an action expert that reads its keys and values."""

from lorasp_jax.models.smolvla.config import SmolVLAConfig
from lorasp_jax.models.smolvla.smolvla import SmolVLA

Config = SmolVLAConfig

__all__ = ["Config", "SmolVLA", "SmolVLAConfig"]
