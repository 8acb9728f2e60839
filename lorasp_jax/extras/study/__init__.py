"""Studies: many runs as one experiment, with scheduling and statistics."""

from lorasp_jax.extras.study.study import Cell, Derived, Study

__all__ = ["Cell", "Derived", "Study"]
