"""LoRA-SP (arXiv 2603.07404)."""

from lorasp_jax.kernels.energy_gate import energy_gate
from lorasp_jax.peft.lora_sp.method import LoRASP
from lorasp_jax.peft.lora_sp.schedule import EnergySchedule

__all__ = ["EnergySchedule", "LoRASP", "energy_gate"]
