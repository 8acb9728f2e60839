"""Poses of all frames agree with MuJoCo's."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.physics import physics

# Features that only users' arms have: several joints on a body, away from its center,
# a ball, and bodies that hang on a free one.
ODD = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <body pos=".1 .2 .3" quat=".5 .1 -.7 .2">
      <joint type="slide" axis="1 2 3" pos=".1 0 0"/>
      <joint type="hinge" axis="0 1 1" pos=".1 .2 -.3" ref=".4"/>
      <joint type="hinge" axis="1 0 0" pos="-.2 .1 0"/>
      <geom size=".1" pos=".1 0 .2" quat="1 2 3 4"/>
      <body pos="0 .3 0" quat="1 0 1 0">
        <joint type="ball" pos=".1 -.1 .2"/>
        <geom type="box" size=".1 .2 .3" pos=".3 0 0" quat="1 1 0 0"/>
        <body pos="0 0 .5"><geom size=".1"/><site name="s" pos=".1 .2 .3" quat="0 1 0 1"/></body>
      </body>
    </body>
    <body pos="1 0 0">
      <freejoint/>
      <geom size=".1" pos="0 .1 0"/>
      <body pos=".2 0 0"><joint type="hinge" axis="0 0 1" pos="0 .1 0"/><geom size=".1"/></body>
    </body>
  </worldbody>
</mujoco>
"""
POSES = {"xpos": 3, "xquat": 4, "xmat": 9, "xipos": 3, "ximat": 9}
POSES |= {"geom_xpos": 3, "geom_xmat": 9, "site_xpos": 3, "site_xmat": 9}


def assert_as_mujoco(model):
    ours = physics.Physics(model, "jax")
    qpos = model.qpos0 + np.random.default_rng(0).normal(size=model.nq)
    start = ours._data.replace(qpos=jnp.asarray(qpos, jnp.float32))
    found = jax.jit(ours._kinematics)(ours._model, start)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_normalizeQuat(model, data.qpos)
    np.testing.assert_allclose(found.qpos, data.qpos, atol=1e-6)
    for name, width in POSES.items():
        expected = getattr(data, name).reshape(-1, width)
        np.testing.assert_allclose(
            getattr(found, name).reshape(-1, width), expected, atol=3e-6, err_msg=name
        )
    turns = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_BALL))
    np.testing.assert_allclose(found.xanchor[turns], data.xanchor[turns], atol=3e-6)
    moves = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    np.testing.assert_allclose(found.xaxis[moves], data.xaxis[moves], atol=3e-6)


def test_every_scene(scene):
    assert_as_mujoco(scene.model)


def test_every_kind_of_joint():
    assert_as_mujoco(mujoco.MjModel.from_xml_string(ODD))
