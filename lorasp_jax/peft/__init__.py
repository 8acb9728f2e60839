"""Adapter methods, framework-free: one frozen dataclass in one file each.

`create("lora_sp", rank=64)` finds a method by its file's name; a new file is a new method.
"""

from lorasp_jax.peft.full import FullFineTuning
from lorasp_jax.peft.lora import LoRA
from lorasp_jax.peft.lora_sp import LoRASP
from lorasp_jax.peft.method import Aux, Method, create, find, names

__all__ = ["Aux", "FullFineTuning", "LoRA", "LoRASP", "Method", "create", "find", "names"]
