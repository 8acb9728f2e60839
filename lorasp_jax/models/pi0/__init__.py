"""pi0 and pi0.5: SigLIP and two Gemma experts with shared attention, for flow matching."""

from lorasp_jax.models.config import ExpertConfig, VisionConfig
from lorasp_jax.models.pi0.pi0 import Pi0, Pi0Config

Config = Pi0Config

__all__ = ["Config", "ExpertConfig", "Pi0", "Pi0Config", "VisionConfig"]
