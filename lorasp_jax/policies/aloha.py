"""Convert ALOHA's states and actions to the joint space of pi0's pretraining, and back.

Fourteen numbers: six joints [rad] and a gripper per arm. Some joints turn the other way. The
robot's program measures a gripper as a linear position and commands it as an angle, each scaled to
[0, 1]; pi0 has angles scaled to another range for both. The numbers are those of the arm's drivers,
as in openpi (policies/aloha_policy.py at 15a9616a).
"""

import jax
import jax.numpy as jnp
import numpy as np

NUMBERS = 14
"""Length of states and actions."""
_SIGNS = np.array([1, -1, -1, 1, 1, 1, 1] * 2, np.float32)
GRIPPERS = 6, 13
"""Dimensions that are grippers."""
_LINEAR = 0.01844, 0.05800  # position of a closed and an open gripper [m]
_HORN, _ARM = 0.022, 0.036  # lengths in the gripper's linkage [m]
_PI0 = 0.5476, 1.6296  # angles that pi0 has as 0 and 1 [rad]
_COMMANDED = -0.6213, 1.4910  # angles that the robot's commands have as 0 and 1 [rad]


def state_to_pi0(state: jax.Array) -> jax.Array:
    """Convert measured states `[..., 14]`."""
    state = jnp.asarray(state) * _SIGNS
    low, high = _LINEAR
    position = state[..., GRIPPERS] * (high - low) + low
    sine = (_HORN**2 + position**2 - _ARM**2) / (2 * _HORN * position)
    closed, opened = _PI0
    angle = (jnp.arcsin(jnp.clip(sine, -1, 1)) - closed) / (opened - closed)
    return state.at[..., GRIPPERS].set(angle)


def actions_from_pi0(actions: jax.Array) -> jax.Array:
    """Convert predicted actions `[..., C, 14]` to commands.

    A predicted gripper is shifted, not scaled, as in openpi.
    """
    actions, (low, high) = jnp.asarray(actions) * _SIGNS, _COMMANDED
    return actions.at[..., GRIPPERS].set((actions[..., GRIPPERS] + _PI0[0] - low) / (high - low))


def actions_to_pi0(actions: jax.Array) -> jax.Array:
    """Invert `actions_from_pi0`."""
    actions, (low, high) = jnp.asarray(actions) * _SIGNS, _COMMANDED
    return actions.at[..., GRIPPERS].set(actions[..., GRIPPERS] * (high - low) + low - _PI0[0])
