"""The arms of the PiPER family, which differ in geometry and limits but not on the bus.

The numbers of PiPER-X and PiPER-H are AgileX's: limits and bus from pyAgxArm (`api/constants.py`,
`docs/piper/firmware_reference.md`: of what differs by arm, only MIT and CPV frames, which are never
sent here), geometry from agx_arm_urdf (`piper_x/urdf`, `piper_h/urdf`). Speed, acceleration and
stroke are taken to be the PiPER's. Nobody has tried them here.
"""

from dataclasses import dataclass

import numpy as np

from envs.robots import TIP_LENGTH, rotation, translation
from envs.robots.piper import ROBOT, SDK_OFFSET

_TIPS = 0.1425
"""From link 6 to the finger tips with the flange of newer arms [m]: 4.5 mm and 138 mm, as the
agx_arm_urdf's `*_with_gripper_description.urdf`."""
_FOLDED, _LOWERED = np.array([0.0, 0.06, -0.06, 0.0, 0.0, 0.0]), 0.35  # rad; our choices
_HALF, _FULL = np.pi / 2, np.pi


@dataclass(frozen=True, eq=False)
class Model:
    """An arm; angles are in rad, lengths in m.

    Attributes:
        chain: [6, 4, 4] transform from the previous link (first the base) to each joint at 0.
        tips: from link 6 to the finger tips along its z axis.
        lower, upper: [6] limits, from the zeros in use here and from the firmware's.
        offset: [6] angles here minus those of a firmware with piper_sdk's default zeros.
        home: [6] pose in which the hand points at the table.
        rest: [7] pose in which the arm lies folded: all joints near zero, the hand lowered.
    """

    chain: np.ndarray
    tips: float
    lower: np.ndarray
    upper: np.ndarray
    offset: np.ndarray
    home: np.ndarray
    rest: np.ndarray


def _joint(x: float, y: float, z: float, roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Return the transform of a URDF's origin."""
    turned = rotation("z", yaw) @ rotation("y", pitch) @ rotation("x", roll)
    return translation(x, y, z) @ turned


def _wrist(bend: int, size: float) -> np.ndarray:
    """Return angles [6] that are 0, but for the joint (from 1) that lowers the hand."""
    return size * np.eye(6)[bend - 1]


def _model(joints: tuple, wrist: tuple[float, float], bend: int) -> Model:
    """Return an arm in its firmware's own zeros, whose first three joints have PiPER's limits."""
    upper = np.deg2rad([150.0, 180.0, 0.0, *wrist, 120.0])
    return Model(
        chain=np.stack([_joint(*row) for row in joints]),
        tips=_TIPS,
        lower=np.append(np.deg2rad([-150.0, 0.0, -170.0]), -upper[3:]),
        upper=upper,
        offset=np.zeros(6),
        home=ROBOT.home * [1, 1, 1, 0, 0, 0] + _wrist(bend, ROBOT.home[4]),
        rest=np.append(_FOLDED + _wrist(bend, _LOWERED), 0.0),
    )


PIPER = Model(
    chain=ROBOT.chain,
    tips=float(ROBOT.tool[2, 3]) + TIP_LENGTH,
    lower=ROBOT.lower,
    upper=ROBOT.upper,
    offset=SDK_OFFSET,
    home=ROBOT.home,
    rest=np.append(_FOLDED + _wrist(5, _LOWERED), 0.0),
)
MODELS = {
    "piper": PIPER,
    "piper-x": _model(
        (
            (0, 0, 0.123, 0, 0, _FULL),
            (0, 0, 0, -_HALF, -3.005806, -_FULL),
            (0.28503, 0, 0, 0, 0, 2.8380798),
            (0.27364, 0, 0, 0, 0, 0.0806342),
            (0.07466, 0, 0, -_HALF, _HALF, 0),
            (0, -0.035, 0, _HALF, 0, 0),
        ),
        wrist=(89.0, 89.0),
        bend=4,
    ),
    "piper-h": _model(
        (
            (0, 0, 0.123, 0, 0, 0),
            (0, 0, 0, _HALF, -0.1357866, -_FULL),
            (0.28503, 0, 0, 0, 0, -1.7938494),
            (-0.02198, -0.25575, 0, _HALF, 0, 0),
            (0, 0, 0, -_HALF, 0, 0),
            (0, -0.0963, 0, _HALF, 0, 0),
        ),
        wrist=(135.0, 89.5),
        bend=5,
    ),
}
"""By the name that `--arm` takes."""
