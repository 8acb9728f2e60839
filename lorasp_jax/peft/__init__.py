"""Framework-agnostic adapter methods, one frozen dataclass per file or folder.

`create("lora_sp", rank=64)` finds a method by its module name, so a new method is one new file.
Modules that begin with `_` are shared by the methods.
"""

import difflib
import importlib
import pkgutil
from typing import Any

from lorasp_jax.peft._aux import Aux
from lorasp_jax.peft._fields import short
from lorasp_jax.peft._method import Method
from lorasp_jax.peft._settings import to_settings, without_removed
from lorasp_jax.peft.ada_lora import AdaLoRA
from lorasp_jax.peft.dora import DoRA
from lorasp_jax.peft.full import FullFineTuning
from lorasp_jax.peft.lora import LoRA
from lorasp_jax.peft.lora_moe import LoRAMoE
from lorasp_jax.peft.lora_sp import LoRASP
from lorasp_jax.peft.lora_sp_release import LoRASPRelease

__all__ = [
    "AdaLoRA",
    "Aux",
    "DoRA",
    "FullFineTuning",
    "LoRA",
    "LoRAMoE",
    "LoRASP",
    "LoRASPRelease",
    "Method",
    "create",
    "find",
    "from_settings",
    "names",
    "to_settings",
]


def names() -> list[str]:
    """Names of all methods."""
    return sorted(m.name for m in pkgutil.iter_modules(__path__) if not m.name.startswith("_"))


def find(name: str) -> type[Method]:
    """Return the method class defined in the module `name`.

    Raises:
      ValueError: unknown method; the message lists the valid names.
    """
    if name not in names():
        close = difflib.get_close_matches(str(name), names(), n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        valid = ", ".join(names())
        raise ValueError(f"unknown method {short(name)}{hint}; valid methods are {valid}")
    module = importlib.import_module(f"{__name__}.{name}")
    classes = [c for c in vars(module).values() if isinstance(c, type) and issubclass(c, Method)]
    (cls,) = [c for c in classes if f"{c.__module__}.".startswith(f"{module.__name__}.")]
    return cls


def create(name: str, **fields: Any) -> Method:
    """Create a method by name, such as "lora", "lora_sp" or "full".

    Raises:
      ValueError: unknown method, unknown field or invalid value.
    """
    return find(name)(**fields)


def from_settings(settings: Any) -> Method:
    """Create a method from settings written by `to_settings`.

    Raises:
      ValueError: `settings` does not name a method, or `create` rejects it.
    """
    if not isinstance(settings, dict) or not isinstance(settings.get("method"), str):
        raise ValueError(f"adapter settings must name a method, got {short(settings)}")
    fields = without_removed(settings)
    return create(fields.pop("method"), **fields)
