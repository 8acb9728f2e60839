"""pi0: SigLIP, two Gemma experts with shared attention, flow matching over actions."""

from lorasp_jax.models.pi0.config import ExpertConfig, Pi0Config, VisionConfig
from lorasp_jax.models.pi0.pi0 import Pi0

Config = Pi0Config

__all__ = ["Config", "ExpertConfig", "Pi0", "Pi0Config", "VisionConfig"]
