"""Vision-language-action backbones, each a subpackage, and their checkpoints."""

from lorasp_jax.models import pi0, smolvla
from lorasp_jax.models.checkpoints import openpi_configs, published
from lorasp_jax.models.checkpoints.loading import load, load_config
from lorasp_jax.models.checkpoints.native import save, set_arrays, weights_hash
from lorasp_jax.models.checkpoints.published import lerobot_names
from lorasp_jax.models.observation import Observation

__all__ = [
    "Observation",
    "lerobot_names",
    "load",
    "load_config",
    "openpi_configs",
    "pi0",
    "published",
    "save",
    "set_arrays",
    "smolvla",
    "weights_hash",
]
