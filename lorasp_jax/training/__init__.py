"""Training: the step, the loop around it, checkpoints and what a run leaves."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lorasp_jax.training.export import load_policy

__all__ = ["load_policy"]


def __getattr__(name: str) -> Any:
    """Public names, imported when asked for: `train.py --help` needs none of them."""
    if name == "load_policy":
        from lorasp_jax.training.export import load_policy

        return load_policy
    raise AttributeError(f"module 'lorasp_jax.training' has no attribute {name!r}")
