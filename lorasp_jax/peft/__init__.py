"""Adapter methods, framework-free: one frozen dataclass in one file or folder each.

`create("lora_sp", rank=64)` finds a method by its file's name; a new file is a new method. Names
that begin with `_` hold what methods share.
"""

import difflib
import importlib
import pkgutil
from typing import Any

from lorasp_jax.peft._aux import Aux
from lorasp_jax.peft._fields import check_names, short
from lorasp_jax.peft._method import Method
from lorasp_jax.peft._settings import to_settings, upgrade
from lorasp_jax.peft.ada_lora import AdaLoRA
from lorasp_jax.peft.dora import DoRA
from lorasp_jax.peft.full import FullFineTuning
from lorasp_jax.peft.lora import LoRA
from lorasp_jax.peft.lora_moe import LoRAMoE
from lorasp_jax.peft.lora_sp import EnergySchedule, LoRASP
from lorasp_jax.peft.lora_sp_release import LoRASPRelease

__all__ = [
    "AdaLoRA",
    "Aux",
    "DoRA",
    "EnergySchedule",
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
    """Names of the methods: the files and folders of this package, but for `_names`."""
    return sorted(m.name for m in pkgutil.iter_modules(__path__) if not m.name.startswith("_"))


def find(name: str) -> type[Method]:
    """The method class in the file `name`.

    Raises:
      ValueError: there is no such file; lists what exists.
    """
    if name not in names():
        close = difflib.get_close_matches(str(name), names(), n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        raise ValueError(f"unknown method {short(name)}{hint}; valid are {', '.join(names())}.")
    module = importlib.import_module(f"{__name__}.{name}")
    classes = [c for c in vars(module).values() if isinstance(c, type) and issubclass(c, Method)]
    (cls,) = [c for c in classes if f"{c.__module__}.".startswith(f"{module.__name__}.")]
    return cls


def create(name: str, **fields: Any) -> Method:
    """The method `name` (a file name: lora, lora_sp, full) with some fields set.

    Raises:
      ValueError: unknown method, unknown field or a bad value.
    """
    return find(name)(**fields)


def from_settings(settings: Any) -> Method:
    """The method that `to_settings` wrote, in this version or an earlier one.

    Raises:
      ValueError: no settings of a method, or as for `create`.
    """
    if not isinstance(settings, dict) or not isinstance(settings.get("method"), str):
        raise ValueError(f"an adapter has settings {short(settings)}, which name no method.")
    fields = upgrade(settings)
    if isinstance(schedule := fields.get("schedule"), dict):
        check_names(EnergySchedule, "schedule", (), schedule)
        fields["schedule"] = EnergySchedule(**schedule)
    return create(fields.pop("method"), **fields)
