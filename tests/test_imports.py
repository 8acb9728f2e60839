"""Test that imports go one way: a package imports only packages above it in `PACKAGES`."""

import ast
import re
from pathlib import Path

import pytest

from tests import ROOT

PACKAGES = [
    "lorasp_jax.base",
    "envs",
    "lorasp_jax.kernels",
    "lorasp_jax.peft",
    "lorasp_jax.dense",
    "lorasp_jax.adapters",
    "lorasp_jax.config",
    "lorasp_jax.models",
    "lorasp_jax.policies",
    "lorasp_jax.data",
    "lorasp_jax.training",
    "lorasp_jax.evaluation",
    "lorasp_jax.report",
    "lorasp_jax.reinforce",
    "lorasp_jax.distill_flow",
    "lorasp_jax.cli",
    # The core, which is everything above, imports none of these.
    "lorasp_jax.extras.serving",
    "lorasp_jax.extras.piper",
    "lorasp_jax.extras.judge",
    "lorasp_jax.extras.study",
    "lorasp_jax.extras.latency",
    "lorasp_jax.extras.deployment",
]
PRIVATE = re.compile(r"(jax|flax|optax|orbax)(\..*)?\._|jaxlib\b|jax\.interpreters\b")
"""Private modules, which a dependency may change without notice."""
SOURCES = [
    path
    for top in ("envs", "lorasp_jax")
    for path in sorted((ROOT / top).rglob("*.py"))
    if path not in (ROOT / "lorasp_jax/__init__.py", ROOT / "lorasp_jax/extras/__init__.py")
]


def package(module: str) -> int | None:
    """Return the index of the package that contains `module`, or None for third-party modules."""
    matches = [i for i, name in enumerate(PACKAGES) if f"{module}.".startswith(f"{name}.")]
    return matches[0] if matches else None


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_up(path: Path):
    module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    own = package(module)
    assert own is not None, f"{module} is in no package"
    for name in imported(path):
        other = package(name)
        assert other is None or other <= own, f"{module} imports {name}"
        assert not name.startswith(("configs", "studies")), f"{module} imports {name}"
        if path.name != "_compat.py":
            assert not PRIVATE.match(name), f"{module} imports {name}: only _compat.py may"


def test_wrong_imports_are_detected():
    assert package("lorasp_jax.report.html") > package("lorasp_jax.training.step")
    assert package("jax.numpy") is None
    assert PRIVATE.match("jax._src.core")
    assert not PRIVATE.match("jax.numpy")
