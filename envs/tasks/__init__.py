"""Manipulation tasks: one module per task, found by the `TASK` that it defines.

Shared module: `_task`, with the class of tasks and helpers for them.
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
