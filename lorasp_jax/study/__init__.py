"""Studies: many runs as one experiment, with scheduling, statistics and claims."""

from lorasp_jax.study.study import Cell, Derived, Study

__all__ = ["Cell", "Derived", "Study"]
