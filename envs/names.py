"""Names of tasks and robots, read from their file names without importing them."""

import pkgutil
from pathlib import Path


def names(kind: str) -> list[str]:
    """List all names of a kind, "task" or "robot"; modules that begin with `_` are skipped."""
    folder = Path(__file__).parent / f"{kind}s"
    modules = (module.name for module in pkgutil.iter_modules([str(folder)]))
    return sorted(name for name in modules if not name.startswith("_"))


def check(kind: str, name: str) -> None:
    """Raise a ValueError that lists the known names if there is no task or robot of this name."""
    if name not in names(kind):
        raise ValueError(f"unknown {kind} {name!r}: choose from {', '.join(names(kind))}")
