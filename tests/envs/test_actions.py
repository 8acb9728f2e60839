"""Action modes describe the same motion, and the expert works in all of them."""

import dataclasses

import jax
import numpy as np
import pytest

from envs import actions, names, robots
from envs.experts import collection


@pytest.fixture
def robot(robot_name):
    return getattr(robots, robot_name).ROBOT


def command(robot, key):
    """Return targets near home, and others a little farther away."""
    draw = np.random.default_rng(key).normal(size=(2, robot.num_joints))
    joints = robot.home + np.array([[0.05], [0.1]]) * draw
    return np.concatenate([joints, [[0.02], [0.04]]], axis=1, dtype=np.float32)


from_targets = jax.jit(actions.from_targets, static_argnums=(0, 1))
to_targets = jax.jit(actions.to_targets, static_argnums=(0, 1))
tool_pose = jax.jit(robots.tool_pose, static_argnums=0)


@pytest.mark.parametrize("mode", names.MODES)
def test_bounds_of_each_mode(robot, mode):
    low, high = actions.bounds(mode, robot, 0.1)
    assert len(low) == len(high) == (7 if mode == "end_effector" else robot.num_joints + 1)
    assert (low < high).all()
    assert (low[-1], high[-1]) == (0.0, np.float32(robot.stroke))
    twice = actions.bounds(mode, robot, 0.2)[1][:-1]
    np.testing.assert_allclose(twice, high[:-1] * (1 if mode == "joint" else 2), rtol=1e-6)


def test_delta_joint_is_a_difference(robot):
    now, then = command(robot, 0)
    action = from_targets("delta_joint", robot, now, then)
    np.testing.assert_allclose(action[:-1], then[:-1] - now[:-1], atol=1e-6)
    assert action[-1] == then[-1]  # the opening is absolute
    np.testing.assert_allclose(to_targets("delta_joint", robot, now, action), then, atol=1e-6)


def test_end_effector_reaches_the_same_pose(robot):
    now, then = command(robot, 1)
    action = from_targets("end_effector", robot, now, then)
    found = to_targets("end_effector", robot, now, action)
    for ours, theirs in zip(
        tool_pose(robot, found[:-1])[:2], tool_pose(robot, then[:-1])[:2], strict=True
    ):
        np.testing.assert_allclose(ours, theirs, atol=3e-3)
    assert found[-1] == then[-1]


def test_end_effector_moves_in_the_base_frame(robot):
    now, _ = command(robot, 2)
    action = np.array([0.02, 0.0, -0.01, 0.0, 0.0, 0.2, 0.03], np.float32)
    found = to_targets("end_effector", robot, now, action)
    (start, before, _), (end, after, _) = (tool_pose(robot, q[:-1]) for q in (now, found))
    np.testing.assert_allclose(np.subtract(end, start), action[:3], atol=2e-3)
    turn = np.asarray(after) @ np.asarray(before).T  # about the vertical
    np.testing.assert_allclose(turn[:2, :2], [[0.980, -0.199], [0.199, 0.980]], atol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["delta_joint", "end_effector"])
def test_expert_works_in_every_mode(env, mode):
    other = dataclasses.replace(env, actions=mode)
    rollout = jax.jit(collection.rollout, static_argnums=0)
    _, _, tries, success = rollout(other, jax.random.key(0))
    assert tries["action"].shape[-1] == 7
    low, high = other.action_low, other.action_high
    assert ((tries["action"] >= low - 1e-6) & (tries["action"] <= high + 1e-6)).all()
    assert success.all()


@pytest.mark.slow
def test_rollout(env):
    def policy(seen, key):
        del key
        assert seen["image"]["side"].shape == (4, 16, 16, 3)
        assert seen["instruction"].shape == (4,)
        return seen["state"].at[:, 0].add(0.05)

    last, went = jax.jit(lambda key: env.rollout(policy, key))(jax.random.key(1))
    assert went.action.shape == went.state.shape == (env.max_steps, 4, 7)
    np.testing.assert_allclose(went.action[..., 0], went.state[..., 0] + 0.05, atol=1e-6)
    assert (went.state[20, :, 0] > went.state[0, :, 0] + 0.3).all()
    assert went.done[-1].all()
    np.testing.assert_array_equal(last.info["steps"], env.max_steps)
    assert not went.reward.any()
