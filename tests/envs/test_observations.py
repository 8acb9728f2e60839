"""The privileged state against MuJoCo's own engine."""

import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs import observations
from tests.envs import expert_in_c

_DT = 1e-5  # s, of a difference quotient


def seen(scene, data) -> dict[str, np.ndarray]:
    command = jnp.arange(scene.num_joints + 1.0)
    bodies = scene.task.place(jax.random.key(0))
    found = observations.parts(scene.model, data, command, bodies)
    return {name: np.asarray(value, np.float64) for name, value in found.items()}


def axes(part) -> np.ndarray:
    """Return the rotation [3, 3] of a pose [9]."""
    x, y = part[3:6], part[6:9]
    return np.stack([x, y, np.cross(x, y)], axis=1)


def test_layout_matches_the_parts(scene):
    found = seen(scene, expert_in_c.world(scene))
    layout = scene.full_state_layout
    assert list(layout) == list(found)
    ends = np.cumsum([0, *(len(part) for part in found.values())])
    assert [(part.start, part.stop) for part in layout.values()] == list(itertools.pairwise(ends))
    bodies = scene.task.place(jax.random.key(0))
    assert set(bodies) < set(layout)
    for name in bodies:
        assert (f"{name}_speed" in layout) == bool(scene.model.body(name).jntnum[0])


def test_joints_of_objects_are_included(scene):
    """Every degree of freedom belongs to the robot or to a body of the layout."""
    speeds = [
        part for name, part in seen(scene, expert_in_c.world(scene)).items() if "speed" in name
    ]
    slides = sum("/" in name for name in scene.full_state_layout)
    # The two fingers are one opening.
    assert sum(map(len, speeds)) + slides == scene.model.nv - 1


def test_poses_and_speeds(scene):
    data = expert_in_c.world(scene)
    data.qvel[:] = np.random.default_rng(0).normal(0, 0.5, scene.model.nv)
    before, tcp = seen(scene, data), data.site("tcp").xpos.copy()
    np.testing.assert_allclose(before["tool"][:3], tcp, atol=5e-6)
    np.testing.assert_allclose(axes(before["tool"]).ravel(), data.site("tcp").xmat, atol=5e-6)
    poses = {n: data.body(n).xpos - tcp for n in scene.task.place(jax.random.key(0))}
    for name, position in poses.items():
        np.testing.assert_allclose(before[name][:3], position, atol=5e-6)
        np.testing.assert_allclose(axes(before[name]).ravel(), data.body(name).xmat, atol=5e-6)
    old = {name: (data.body(name).xpos.copy(), data.body(name).xmat.copy()) for name in poses}
    joints = data.qpos[: scene.num_joints].copy()
    mujoco.mj_integratePos(scene.model, data.qpos, data.qvel, _DT)
    mujoco.mj_kinematics(scene.model, data)
    moved = (data.qpos[: scene.num_joints] - joints) / _DT
    np.testing.assert_allclose(before["joint_speeds"][:-1], moved, atol=1e-4)
    for name, (position, rotation) in old.items():
        if f"{name}_speed" not in before:
            continue
        speed = before[f"{name}_speed"]
        moved = (data.body(name).xpos - position) / _DT
        np.testing.assert_allclose(speed[:3], moved, atol=1e-4)
        turned = (data.body(name).xmat - rotation).reshape(3, 3) / _DT
        spin = np.cross(speed[3:], rotation.reshape(3, 3), axisb=0, axisc=0)
        np.testing.assert_allclose(turned, spin, atol=1e-3)


def test_full_state_follows_the_layout(env):
    state = env.reset(jax.random.key(0))
    found, layout = np.asarray(env.full_state(state)), env.full_state_layout
    assert found.shape == (4, max(part.stop for part in layout.values()))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found[:, layout["joints"]], env.proprio(state), atol=1e-6)
    np.testing.assert_array_equal(found[:, layout["command"]], state.info["command"])
    place = found[:, layout["button"]][:, :3] + found[:, layout["tool"]][:, :3]
    np.testing.assert_allclose(place, state.info["layout"]["button"][:, :3], atol=1e-6)
