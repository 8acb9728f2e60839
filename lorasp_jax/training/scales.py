"""Comparison of an experiment's scales, for the help text."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

from lorasp_jax.config import SCALES, Config


def differences(config_at: Callable[[str], Config]) -> str:
    """Return a table of the fields that differ between scales, or "" if none do.

    `config_at` returns the experiment's config at a scale.
    """
    configs = [dict(_values(config_at(scale))) for scale in SCALES]
    names = dict.fromkeys(name for config in configs for name in config)
    rows = [(name, *(config.get(name, "-") for config in configs)) for name in names]
    rows = [row for row in rows if len(set(row[1:])) > 1]
    if not rows:
        return ""
    table = [("--scale", *SCALES), *rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = ("  ".join(map(str.ljust, row, widths)).rstrip() for row in table)
    return "fields set by --scale:\n" + "".join(f"  {line}\n" for line in lines)


def _values(config: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield option names and values of all fields except the scale."""
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), prefix + field.name.replace("_", "-")
        if dataclasses.is_dataclass(value):
            yield from _values(value, f"{name}.")
        elif name != "scale":
            text = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
            yield f"--{name}", text or "(empty)"
