"""Training: setup, step, loop, checkpoints and export of a run."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lorasp_jax.training.export import load_policy

__all__ = ["load_policy"]


def __getattr__(name: str) -> Any:
    """Import public names lazily, because `train.py --help` does not need them."""
    if name == "load_policy":
        from lorasp_jax.training.export import load_policy

        return load_policy
    raise AttributeError(f"module 'lorasp_jax.training' has no attribute {name!r}")
