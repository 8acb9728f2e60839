"""LoRA-SP (arXiv 2603.07404)."""

from lorasp_jax.kernels.energy_gate import energy_gate
from lorasp_jax.peft.lora_sp.method import LoRASP

__all__ = ["LoRASP", "energy_gate"]
