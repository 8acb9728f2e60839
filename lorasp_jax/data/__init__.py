"""From episodes to training batches."""

from lorasp_jax.data import cache
from lorasp_jax.data.opening import open_source
from lorasp_jax.data.stream import Stream

__all__ = ["Stream", "cache", "open_source"]
