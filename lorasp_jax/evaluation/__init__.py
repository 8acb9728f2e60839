"""Closed-loop evaluation in simulation."""

from lorasp_jax.evaluation.results import Result, evaluate
from lorasp_jax.evaluation.rollout import make_rollout

__all__ = ["Result", "evaluate", "make_rollout"]
