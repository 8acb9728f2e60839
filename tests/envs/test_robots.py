"""Kinematics against the vendor's SDK and MuJoCo, limits against published numbers."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs import robots
from envs.names import names
from envs.robots import piper
from tests import GOLDEN

GOLDEN = np.load(GOLDEN / "piper_fk.npz")


def at_pose(scene, q) -> mujoco.MjData:
    data = mujoco.MjData(scene.model)
    data.qpos[: len(q)] = q
    mujoco.mj_forward(scene.model, data)
    return data


def random_poses(robot, number: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(robot.lower, robot.upper, (number, robot.num_joints))


def test_only_modules_that_define_a_robot_are_robots():
    assert names("robot") == ["panda", "piper"]


@pytest.mark.parametrize("offset", [0, 1])
def test_piper_kinematics_match_the_sdk(offset):
    q = jnp.asarray(GOLDEN["q"], jnp.float32)
    position, rotation = jax.jit(piper.forward_kinematics, static_argnames="sdk_offset")(
        q, sdk_offset=bool(offset)
    )
    np.testing.assert_allclose(position, GOLDEN[f"position{offset}"], atol=2e-6)
    np.testing.assert_allclose(rotation, GOLDEN[f"rotation{offset}"], atol=5e-6)


def test_piper_kinematics_need_six_angles():
    with pytest.raises(ValueError, match=r"\[\.\.\., 6\]"):
        piper.forward_kinematics(jnp.zeros(7))


@pytest.mark.parametrize("task_name", ["press"])
@pytest.mark.parametrize("robot_name", ["piper"])
def test_piper_bodies_match_the_sdk(scene):
    for q, positions in zip(GOLDEN["q"], GOLDEN["position0"], strict=True):
        data = at_pose(scene, q)
        found = [data.body(f"link{i}").xpos for i in range(1, 7)]
        np.testing.assert_allclose(found, positions, atol=1e-5)  # 0.01 mm


@pytest.mark.parametrize("task_name", ["press"])
def test_tool_pose_matches_mujoco(scene, robot_name):
    robot = scene.robot
    tool_pose = jax.jit(lambda q: robots.tool_pose(robot, q))
    site = scene.model.site("tcp").id
    for q in random_poses(robot, 20):
        data = at_pose(scene, q)
        position, rotation, jacobian = tool_pose(jnp.asarray(q, jnp.float32))
        expected = np.zeros((6, scene.model.nv))
        mujoco.mj_jacSite(scene.model, data, expected[:3], expected[3:], site)
        np.testing.assert_allclose(position, data.site_xpos[site], atol=2e-6)
        np.testing.assert_allclose(rotation.ravel(), data.site_xmat[site], atol=5e-6)
        np.testing.assert_allclose(jacobian, expected[:, : robot.num_joints], atol=5e-6)


@pytest.mark.parametrize("task_name", ["press"])
def test_robots_are_complete(scene, robot_name):
    robot = scene.robot
    assert robot.name == robot_name
    for numbers in (robot.lower, robot.upper, robot.speed, robot.home, robot.body.stiffness):
        assert numbers.shape == (robot.num_joints,)
    assert np.all(robot.lower < robot.home)
    assert np.all(robot.home < robot.upper)
    np.testing.assert_allclose(scene.model.jnt_range[: robot.num_joints, 0], robot.lower)
    data = at_pose(scene, robot.home)
    np.testing.assert_allclose(data.site("tcp").xpos, [0.34, 0, 0.18], atol=1e-3)
    x, y, z = data.site("tcp").xmat.reshape(3, 3).T
    assert y[1] > 0.999  # fingers open sideways
    assert np.arccos(-z[2]) == pytest.approx(robot.lean, abs=0.01)
    assert x[0] < 0  # towards the base, which makes the lean go outwards


@pytest.mark.parametrize("task_name", ["press"])
def test_fingers_follow_the_opening(scene, robot_name):
    model, joints = scene.model, scene.num_joints
    data = at_pose(scene, scene.robot.home)
    data.ctrl[:] = np.append(scene.robot.home, scene.robot.stroke / 2)
    for _ in range(300):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(
        data.qpos[:joints], scene.robot.home, atol=2e-3
    )  # gravity compensated
    np.testing.assert_allclose(data.qpos[joints : joints + 2], scene.robot.stroke / 2, atol=1e-3)
    gap = data.geom_xpos[pads(model)[0]] - data.geom_xpos[pads(model)[1]]
    thickness = 2 * model.geom_size[pads(model)[0], 1]
    assert np.linalg.norm(gap) - thickness == pytest.approx(scene.robot.stroke, abs=2e-3)


def pads(model) -> list[int]:
    return [int(model.body(side).geomadr[0]) for side in ("left", "right")]
