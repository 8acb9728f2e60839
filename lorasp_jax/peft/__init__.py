"""Adapter methods, framework-free: one frozen dataclass in one file each.

`create("lora_sp", rank=64)` finds a method by its file's name; a new file is a new method.
"""

from lorasp_jax.peft.ada_lora import AdaLoRA
from lorasp_jax.peft.dora import DoRA
from lorasp_jax.peft.full import FullFineTuning
from lorasp_jax.peft.lora import LoRA
from lorasp_jax.peft.lora_moe import LoRAMoE
from lorasp_jax.peft.lora_sp import LoRASP
from lorasp_jax.peft.method import Aux, Method, create, find, names

__all__ = [
    "AdaLoRA",
    "Aux",
    "DoRA",
    "FullFineTuning",
    "LoRA",
    "LoRAMoE",
    "LoRASP",
    "Method",
    "create",
    "find",
    "names",
]
