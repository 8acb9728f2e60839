"""Convert methods to JSON settings and back."""

import dataclasses
from collections.abc import Mapping
from typing import Any

Settings = dict[str, Any]

_REMOVED = {"granularity": "token", "schedule": None, "normalized_bank": False}
"""Former options of LoRA-SP, which saved settings may name, and the values that they had."""
_REMOVED_OF_RELEASE = {"hidden_width": None}
_LORA_SP = ("lora_sp", "lora_sp_release", "LoRASP", "LoRASPRelease")


def to_settings(method: Any) -> Settings:
    """The name of a method and its fields, as stored with an adapter; empty `ranks` are not."""
    settings = {"method": method.name, **dataclasses.asdict(method.as_saved)}
    return {name: value for name, value in settings.items() if name != "ranks" or value}


def without_removed(settings: Mapping[str, Any]) -> Settings:
    """Drop LoRA-SP's former options from saved settings.

    Args:
        settings: the fields, plus "method": the name of the method or of its class.

    Raises:
        ValueError: a former option has another value than its default.
    """
    method = str(settings.get("method"))
    if method not in _LORA_SP:
        return dict(settings)
    release = method in ("lora_sp_release", "LoRASPRelease")
    removed = _REMOVED | (_REMOVED_OF_RELEASE if release else {})
    for name in removed.keys() & settings.keys():
        if settings[name] != removed[name]:
            raise ValueError(
                f"LoRA-SP has no option {name} any more, so an adapter trained with "
                f"{name}={settings[name]!r} cannot be used"
            )
    return {name: value for name, value in settings.items() if name not in removed}
