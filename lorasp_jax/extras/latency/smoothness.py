"""How smoothly a robot is commanded."""

import numpy as np

from lorasp_jax.extras.latency.execution import Trace


def action_delta(trace: Trace) -> float:
    """Return the mean change of the joint targets per control step [rad], as a Euclidean norm."""
    return _mean_difference(trace, 1)


def jerk(trace: Trace, control_dt: float) -> float:
    """Return the mean jerk of the joint targets [rad/s^3], as a Euclidean norm.

    The jerk is the third difference of targets that are `control_dt` [s] apart, over control_dt^3.
    """
    return _mean_difference(trace, 3) / control_dt**3


def _mean_difference(trace: Trace, order: int) -> float:
    """Average the norm of a difference of the joint targets over executed steps and worlds."""
    differences = np.diff(trace.commands[..., :-1], n=order, axis=1)  # without the gripper
    norms = np.linalg.norm(differences, axis=-1)
    executed = np.arange(order, order + norms.shape[1]) < trace.steps[:, None]
    return float(norms[executed].mean()) if executed.any() else 0.0
