"""AgileX PiPER: six joints and a parallel gripper with 70 mm stroke.

Kinematics, limits and speeds are from the vendor's `piper_sdk` 0.6.2. Masses and servo gains are
from MuJoCo Menagerie's `agilex_piper` (commit cd165455). Its link masses exclude the motors, so
gravity is compensated and the dynamics are not realistic. Shapes are primitives along the links.
"""

import jax
import jax.numpy as jnp
import numpy as np

from envs import robots

# Modified (Craig) Denavit-Hartenberg table of piper_sdk's C_PiperForwardKinematics, rows of
# (a [m], alpha [rad], d [m], theta0 [rad]); T_i = Rx(alpha) Tx(a) Rz(q + theta0) Tz(d).
# Joints 2 and 3 have the zeros of dh_is_offset=0, the convention of the URDF and of Menagerie.
_DH = np.array(
    [
        [0.0, 0.0, 0.123, 0.0],
        [0.0, -np.pi / 2, 0.0, np.deg2rad(-174.22)],
        [0.28503, 0.0, 0.0, np.deg2rad(-100.78)],
        [-0.02198, np.pi / 2, 0.25075, 0.0],
        [0.0, -np.pi / 2, 0.0, 0.0],
        [0.0, np.pi / 2, 0.091, 0.0],
    ]
)
SDK_OFFSET = np.deg2rad([0.0, 2.0, -2.0, 0.0, 0.0, 0.0])
"""Angles of this model minus those with the SDK's default zeros (dh_is_offset=1) [rad]."""


_CHAIN = np.stack(
    [
        robots.rotation("x", alpha)
        @ robots.translation(a, 0, 0)
        @ robots.rotation("z", theta0)
        @ robots.translation(0, 0, d)
        for a, alpha, d, theta0 in _DH
    ]
)


def forward_kinematics(q: jax.Array, *, sdk_offset: bool = False) -> tuple[jax.Array, jax.Array]:
    """Compute the poses of links 1-6 in the base frame, as `piper_sdk` does.

    Args:
        q: [..., 6] joint angles [rad].
        sdk_offset: use the SDK's default zeros (dh_is_offset=1) of joints 2 and 3, which differ by
            2 degrees from the URDF's. Check which ones your arm's firmware uses.

    Returns:
        Positions [..., 6, 3] in m and rotations [..., 6, 3, 3].

    Raises:
        ValueError: the last axis of q is not 6.
    """
    q = jnp.asarray(q)
    if q.shape[-1:] != (6,):
        raise ValueError(f"q must be [..., 6] joint angles in rad, got shape {q.shape}")
    return robots.forward_kinematics(_CHAIN, q + SDK_OFFSET.astype(q.dtype) if sdk_offset else q)


# Shapes and colors are our choices; masses [kg] are Menagerie's. Link 6 and the hand weigh .45.
_DARK, _GRAY = 'rgba=".13 .14 .16 1"', 'rgba=".30 .32 .35 1"'
_LINKS = (
    f'<geom type="capsule" size=".042" fromto="0 0 -.035 0 0 .01" mass=".098" {_GRAY}/>',
    f'<geom type="capsule" size=".034" fromto="0 0 0 .285 0 0" mass=".291" {_DARK}/>',
    f'<geom type="capsule" size=".030" fromto="0 0 0 -.022 -.24 0" mass=".291" {_GRAY}/>',
    f'<geom type="sphere" size=".034" mass=".127" {_DARK}/>',
    f'<geom type="capsule" size=".028" fromto="0 0 0 0 -.06 0" mass=".145" {_GRAY}/>',
    f'<geom type="cylinder" size=".03 .012" pos="0 0 .008" mass=".1" {_DARK}/>',
)

ROBOT = robots.Robot(
    name="piper",
    chain=_CHAIN,
    # Finger tips are .135 m from link 6 (Menagerie: bodies of links 7 and 8 at z = .13503).
    tool=robots.translation(0, 0, 0.135 - robots.TIP_LENGTH),
    # piper_sdk, JointCtrl limits [rad].
    lower=np.array([-2.6179, 0.0, -2.967, -1.745, -1.22, -2.09439]),
    upper=np.array([2.6179, 3.14, 0.0, 1.745, 1.22, 2.09439]),
    speed=np.full(6, 3.0),  # piper_sdk, [rad/s]
    home=np.array([0.0, 1.528, -1.248, 0.0, 1.029, 0.0]),
    lean=np.deg2rad(20.0),  # our choice
    tilt_side=1,  # tilted inward, joint 5 would soon reach its limit
    stroke=0.07,  # piper_sdk, GripperCtrl [m]
    gripper_speed=0.1,  # our choice, same as the Panda's [m/s]
    body=robots.Primitives(
        stiffness=np.array([80.0, 80.0, 80.0, 40.0, 10.0, 10.0]),
        damping=np.array([5.0, 5.0, 5.0, 5.0, 1.5, 1.5]),
        armature=0.005,
        base=f'<geom type="cylinder" size=".055 .045" pos="0 0 .045" mass=".163" {_DARK}/>',
        links=_LINKS,
        hand=f'<geom type="box" size=".02 .055 .026" pos="0 0 -.077" mass=".35" {_GRAY}/>',
        finger=f'<geom class="pad" size=".012 .004 .03" pos="0 .004 -.018" mass=".026" {_DARK}/>',
        tip_offset=0.004,
    ),
)
