"""Robot arms: one module per robot, found by the `ROBOT` that it defines.

`_robot` and `arm_kinematics` are shared by all robots.
"""

import importlib
import importlib.util
from types import ModuleType

from envs.robots._robot import (
    BASE,
    TIP_LENGTH,
    TIP_RADIUS,
    WRIST_AXES,
    WRIST_FOVY,
    WRIST_POSITION,
    Body,
    Primitives,
    Robot,
    pose,
)
from envs.robots.arm_kinematics import (
    Geometry,
    forward_kinematics,
    inverse_kinematics,
    multiply,
    rotation,
    sine_axis,
    tool_pose,
    translation,
    turn,
)

__all__ = [
    "BASE",
    "TIP_LENGTH",
    "TIP_RADIUS",
    "WRIST_AXES",
    "WRIST_FOVY",
    "WRIST_POSITION",
    "Body",
    "Geometry",
    "Primitives",
    "Robot",
    "forward_kinematics",
    "inverse_kinematics",
    "multiply",
    "pose",
    "rotation",
    "sine_axis",
    "tool_pose",
    "translation",
    "turn",
]


def __getattr__(name: str) -> ModuleType:
    """Import a robot's module on access, so `envs.robots.piper` works after `import envs`."""
    if importlib.util.find_spec(f"envs.robots.{name}") is None:
        raise AttributeError(f"module 'envs.robots' has no attribute {name!r}")
    return importlib.import_module(f"envs.robots.{name}")
