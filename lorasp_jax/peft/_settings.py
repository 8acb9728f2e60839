"""Convert methods to JSON settings, and upgrade the settings of earlier versions."""

import dataclasses
from collections.abc import Mapping
from typing import Any

Settings = dict[str, Any]

_EARLIER_FIELDS = {
    "score_function",
    "rule",
    "energy_start",
    "energy_curve",
    "energy_share",
    "pruned",
    "gate",
}
"""Fields of LoRA-SP that only earlier versions had."""
_RELEASE_NAMES = {"lora_sp": "lora_sp_release", "LoRASP": "LoRASPRelease"}
_GELU_ROUTERS = {"softplus": "gelu", "relu": "gelu_relu", "softmax": "gelu_softmax"}
"""Score function -> current router name, for settings of earlier versions with router "gelu"."""


def to_settings(method: Any) -> Settings:
    """The name of a method and its fields, as stored with an adapter."""
    return {"method": method.name, **dataclasses.asdict(method.as_saved)}


def upgrade(settings: Mapping[str, Any]) -> Settings:
    """Convert a method's settings from any version to the current format.

    Args:
      settings: the fields, plus "method": the name of the method or of its class.
    """
    old = dict(settings)
    if str(old.get("method")) not in _RELEASE_NAMES or not _EARLIER_FIELDS & old.keys():
        return old
    upgraded = {name: value for name, value in old.items() if name not in _EARLIER_FIELDS}
    if old.get("rule") == "release":
        has_hidden_layer = upgraded.pop("router", None) == "softmax"
        upgraded["hidden_width"] = upgraded.get("hidden_width") if has_hidden_layer else None
        upgraded.pop("granularity", None)
        return {**upgraded, "method": _RELEASE_NAMES[old["method"]]}
    score_function = old.get("score_function", "softplus")
    if upgraded.get("router", "gelu") == "gelu":
        upgraded["router"] = _GELU_ROUTERS.get(str(score_function), score_function)
    start = old.get("energy_start")
    curve, share = old.get("energy_curve", "linear"), old.get("energy_share", 0.5)
    schedule = {"start": start, "curve": curve, "share": share}
    return {**upgraded, "schedule": None if start is None else schedule}
