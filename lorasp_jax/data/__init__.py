"""Datasets and training batches."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lorasp_jax.data import cache
    from lorasp_jax.data.opening import open_source
    from lorasp_jax.data.stream import Stream

__all__ = ["Stream", "cache", "open_source"]

_MODULES = {"Stream": "stream", "open_source": "opening"}


def __getattr__(name: str) -> Any:
    """Import public names lazily, so that `--help` loads neither Grain nor PyArrow."""
    if name in _MODULES:
        return getattr(importlib.import_module(f"lorasp_jax.data.{_MODULES[name]}"), name)
    raise AttributeError(f"module 'lorasp_jax.data' has no attribute {name!r}")
