"""Framework-agnostic adapter methods, one frozen dataclass per file or folder.

`create("lora_sp", rank=64)` finds a method by the name of the module that defines it, so a new
method is one new file.
"""

import difflib
import importlib
import pkgutil
from typing import Any

from lorasp_jax.peft.ada_lora import AdaLoRA
from lorasp_jax.peft.auxiliary import Aux
from lorasp_jax.peft.dora import DoRA
from lorasp_jax.peft.fields import short
from lorasp_jax.peft.full import FullFineTuning
from lorasp_jax.peft.lora import LoRA
from lorasp_jax.peft.lora_moe import LoRAMoE
from lorasp_jax.peft.lora_sp import LoRASP
from lorasp_jax.peft.lora_sp_release import LoRASPRelease
from lorasp_jax.peft.method import Method
from lorasp_jax.peft.settings import to_settings, without_removed

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


def _classes() -> dict[str, type[Method]]:
    """The method class that each module defines, by the module's name."""
    found: dict[str, type[Method]] = {}
    for name in sorted(module.name for module in pkgutil.iter_modules(__path__)):
        module = importlib.import_module(f"{__name__}.{name}")
        for value in vars(module).values():
            is_method = isinstance(value, type) and issubclass(value, Method)
            if is_method and f"{value.__module__}.".startswith(f"{module.__name__}."):
                found[name] = value
    del found["method"]  # the base class
    return found


def names() -> list[str]:
    """Names of all methods."""
    return list(_classes())


def find(name: str) -> type[Method]:
    """Return the method class defined in the module `name`.

    Raises:
        ValueError: unknown method; the message lists the valid names.
    """
    classes = _classes()
    if name not in classes:
        close = difflib.get_close_matches(str(name), classes, n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        valid = ", ".join(classes)
        raise ValueError(f"unknown method {short(name)}{hint}; valid methods are {valid}")
    return classes[name]


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
    # JSON has no tuples.
    fields = {k: tuple(v) if isinstance(v, list) else v for k, v in settings.items()}
    fields = without_removed(fields)
    return create(fields.pop("method"), **fields)
