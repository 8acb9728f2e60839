"""Robot arms: one file per robot, found by its name.

Modules that begin with `_` hold what all robots share.
"""

import importlib
import importlib.util
from types import ModuleType

from envs.robots._kinematics import (
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
from envs.robots._robot import (
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

__all__ = [
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
    """Import a robot's module on access, so that `import envs` makes `envs.robots.piper` work."""
    if importlib.util.find_spec(f"envs.robots.{name}") is None:
        raise AttributeError(f"module 'envs.robots' has no attribute {name!r}")
    return importlib.import_module(f"envs.robots.{name}")
