"""Closed-loop evaluation in simulation."""

from lorasp_jax.evaluation.rollout import Result, evaluate, make_rollout

__all__ = ["Result", "evaluate", "make_rollout"]
