"""Manipulation tasks: one file per task, found by its name.

Modules that begin with `_` hold what all tasks share.
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
