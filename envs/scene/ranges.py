"""Ranges of domain randomization, and their limits; light to import, for configs."""

import dataclasses
from typing import Any, Self

import jax
import numpy as np

from envs import checks

MAX_GROWTH = 1.25
"""Maximum factor on geom sizes, our choice; Warp's bounding volumes are enlarged by it."""
Range = tuple[float, float]
_POSITIVE = ("size", "mass", "friction", "gains", "brightness")
_MAX_FOV_CHANGE = 20.0  # deg, our choice; the narrowest field of view is 32
_ZERO, _ONE = (0.0, 0.0), (1.0, 1.0)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Randomization:
    """Ranges (low, high) to draw from uniformly; the defaults change nothing.

    Attributes:
        position: common shift of all objects along x and along y [m].
        turn: rotation of each object about its own vertical axis, the same angle for all [rad].
        size: common factor on the size of all objects, which stay on the table.
        mass: factor on each object's mass and inertia.
        friction: common factor on all friction.
        gains: factor on each servo's stiffness and damping.
        camera_position: shift of each camera along each of its axes [m].
        camera_turn: each component of each camera's rotation vector [rad].
        field_of_view: change of each camera's vertical field of view [deg].
        light_turn: each component of the rotation vector of the light's direction [rad].
        brightness: factor on all light.
        colour: change of red, green and blue of each geom, on a scale of 0 to 1.
        latency: delay from an action to its first effect [s], at most one control step.
        table_height: height of the table, with the objects and the side camera, above the robot's
            mount [m]. The experts still succeed from -0.04 to 0.04.
    """

    position: Range = _ZERO
    turn: Range = _ZERO
    size: Range = _ONE
    mass: Range = _ONE
    friction: Range = _ONE
    gains: Range = _ONE
    camera_position: Range = _ZERO
    camera_turn: Range = _ZERO
    field_of_view: Range = _ZERO
    light_turn: Range = _ZERO
    brightness: Range = _ONE
    colour: Range = _ZERO
    latency: Range = _ZERO
    table_height: Range = _ZERO

    @classmethod
    def typical(cls) -> Self:
        """Return moderate ranges for small robots and their cameras; the experts still succeed."""
        return cls(
            position=(-0.01, 0.01),
            turn=(-0.1, 0.1),
            size=(0.95, 1.05),
            mass=(0.7, 1.4),
            friction=(0.8, 1.25),
            gains=(0.8, 1.2),
            camera_position=(-0.01, 0.01),
            camera_turn=(-0.035, 0.035),
            field_of_view=(-2.0, 2.0),
            light_turn=(-0.5, 0.5),
            brightness=(0.7, 1.2),
            colour=(-0.1, 0.1),
            latency=(0.0, 0.04),
        )

    def changed(self) -> dict[str, Range]:
        """Return the ranges that differ from the defaults, by name."""
        default = type(self)()
        return {n: value for n, value in vars(self).items() if value != getattr(default, n)}

    def check(self, control_dt: float) -> None:
        """Raise a ValueError if a range is invalid; latency must not exceed `control_dt` [s]."""
        limits = dict.fromkeys(vars(self), (-np.inf, np.inf)) | {
            "size": (1 / MAX_GROWTH, MAX_GROWTH),
            "field_of_view": (-_MAX_FOV_CHANGE, _MAX_FOV_CHANGE),
            "latency": (0.0, control_dt),
        }
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if not _is_range(value):
                raise ValueError(f"{name} must be two finite numbers (low, high), got {value}")
            if value[0] < low or value[1] > high or (name in _POSITIVE and value[0] <= 0):
                kind = "above 0 and " * (name in _POSITIVE)
                raise ValueError(f"{name} must be {kind}in [{low}, {high}], got {value}")


def _is_range(value: Any) -> bool:
    """Return whether `value` is two numbers, finite in single precision, the lower first."""
    if isinstance(value, tuple | list):
        value = [np.asarray(x) for x in value]
        if not all(x.shape == () and checks.is_numeric(x) for x in value):
            return False
        value = np.array(value)
    if not checks.is_numeric(value) or value.shape != (2,):
        return False
    with np.errstate(over="ignore"):
        low, high = np.asarray(value, np.float32)
    return bool(np.isfinite([low, high]).all() and value[0] <= value[1])
