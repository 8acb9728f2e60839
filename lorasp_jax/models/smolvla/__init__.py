"""SmolVLA: SigLIP, SmolLM2 and an action expert that attends to SmolLM2's keys and values."""

from lorasp_jax.models.smolvla.smolvla import SmolVLA, SmolVLAConfig

Config = SmolVLAConfig

__all__ = ["Config", "SmolVLA", "SmolVLAConfig"]
