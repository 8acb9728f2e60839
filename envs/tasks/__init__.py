"""Manipulation tasks: one module per task, found by the `TASK` that it defines.

The class `Task` and helpers for all tasks are in `_task`.
"""

from envs.tasks._task import (
    Layout,
    Task,
    View,
    Waypoints,
    azimuth,
    gate,
    near,
    open_box,
    raised,
    route,
    scatter,
    tool_down,
)

__all__ = [
    "Layout",
    "Task",
    "View",
    "Waypoints",
    "azimuth",
    "gate",
    "near",
    "open_box",
    "raised",
    "route",
    "scatter",
    "tool_down",
]
