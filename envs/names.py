"""Names of tasks and robots, read from their modules without importing them."""

import re
from pathlib import Path
from typing import Literal, get_args

Mode = Literal["joint", "delta_joint", "end_effector"]
MODES: tuple[str, ...] = get_args(Mode)
"""Action modes; here, because this module is light to import."""


def names(kind: str) -> list[str]:
    """List the modules that define a global `TASK` (kind "task") or `ROBOT` (kind "robot")."""
    defines = re.compile(rf"^{kind.upper()}\b", re.MULTILINE)
    folder = Path(__file__).parent / f"{kind}s"
    return sorted(p.stem for p in folder.glob("[!_]*.py") if defines.search(p.read_text("utf-8")))


def check(kind: str, name: str) -> None:
    """Raise a ValueError that lists the known names if `name` is not one of them."""
    if name not in names(kind):
        raise ValueError(f"unknown {kind} {name!r}: choose from {', '.join(names(kind))}")
