"""A method as JSON, in adapter files and records of runs; and as earlier versions wrote it."""

import dataclasses
from collections.abc import Mapping
from typing import Any

Settings = dict[str, Any]

_EARLIER = {
    "score_function",
    "rule",
    "energy_start",
    "energy_curve",
    "energy_share",
    "pruned",
    "gate",
}
"""Fields that LoRA-SP had."""
_RELEASES = {"lora_sp": "lora_sp_release", "LoRASP": "LoRASPRelease"}
_ROUTERS = {"softplus": "gelu", "relu": "gelu_relu", "softmax": "gelu_softmax"}
"""A router "gelu" by its score function."""


def to_settings(method: Any) -> Settings:
    """Name and fields of a method, of those that belong to a saved adapter."""
    return {"method": method.name, **dataclasses.asdict(method.as_saved)}


def upgrade(settings: Mapping[str, Any]) -> Settings:
    """A method's settings as this version writes them, from those of any version.

    Args:
      settings: "method", a name or that of the class, and the fields.
    """
    found = dict(settings)
    if str(found.get("method")) not in _RELEASES or not _EARLIER & found.keys():
        return found
    now = {name: value for name, value in found.items() if name not in _EARLIER}
    if found.get("rule") == "release":
        projects = now.pop("router", None) == "softmax"
        now["hidden_width"] = now.get("hidden_width") if projects else None
        now.pop("granularity", None)
        return {**now, "method": _RELEASES[found["method"]]}
    score_function = found.get("score_function", "softplus")
    if now.get("router", "gelu") == "gelu":
        now["router"] = _ROUTERS.get(str(score_function), score_function)
    start = found.get("energy_start")
    curve, share = found.get("energy_curve", "linear"), found.get("energy_share", 0.5)
    moves = {"start": start, "curve": curve, "share": share}
    return {**now, "schedule": None if start is None else moves}
