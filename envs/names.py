"""The names of tasks and robots: those of their files, which nobody has to import for that."""

import pkgutil
from pathlib import Path


def names(kind: str) -> list[str]:
    """The names of all of a kind, task or robot; those that begin with `_` are skipped."""
    folder = Path(__file__).parent / f"{kind}s"
    found = (module.name for module in pkgutil.iter_modules([str(folder)]))
    return sorted(name for name in found if not name.startswith("_"))


def check(kind: str, name: str) -> None:
    """Raise ValueError, listing the known names, unless there is a task or robot of this name."""
    if name not in names(kind):
        raise ValueError(f"unknown {kind} {name!r}: choose from {', '.join(names(kind))}")
