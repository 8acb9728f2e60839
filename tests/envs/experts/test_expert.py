"""Experts solve every task with every robot, smoothly, and recordings are faithful."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs import robots
from envs.experts import collection, expert
from envs.physics import physics
from envs.tasks import route
from tests.envs.children import fake_record
from tests.envs.demonstrations import expert_success

LAYOUTS = 256 if jax.default_backend() == "cpu" else 1024
"""Random layouts; pouring in 1,024 takes more than ten minutes on CPU."""


def valid(episodes) -> np.ndarray:
    """Mask of the steps within each episode, bool [E, T]."""
    return np.arange(episodes.state.shape[1]) < episodes.length[:, None]


def test_experts_succeed(episodes):
    assert episodes.num_episodes / episodes.attempted >= 0.95


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("backend", sorted({"jax", physics.default_backend()}))
def test_experts_succeed_on_many_layouts(task_name, robot_name, backend):
    success = expert_success(
        task_name, robot_name, num_episodes=LAYOUTS, num_envs=256, backend=backend
    )
    assert success.shape == (LAYOUTS,)
    assert success.dtype == bool
    assert success.mean() >= 0.97


def test_episodes_are_consistent(episodes, scene):
    episodes.validate()
    steps = scene.expert_steps
    assert episodes.state.shape == (episodes.num_episodes, steps, scene.num_joints + 1)
    assert episodes.image.keys() == {"side", "wrist"}
    assert episodes.image["side"].shape[1:] == (steps, 16, 16, 3)
    assert np.all(episodes.length > 0.4 * steps)
    assert len(np.unique(episodes.length)) > 5
    assert len(np.unique(episodes.instruction)) == len(scene.instructions)
    assert (episodes.task, episodes.robot) == (scene.task.name, scene.robot.name)


def test_actions_respect_the_limits(episodes, scene):
    assert np.all(episodes.action >= scene.action_low - 1e-6)
    assert np.all(episodes.action <= scene.action_high + 1e-6)
    speed = np.abs(np.diff(episodes.action, axis=1)) / scene.control_dt
    assert np.all(speed <= scene.robot.action_speed + 1e-4)
    measured = np.abs(np.diff(episodes.state[..., :-1], axis=1)) / scene.control_dt
    assert np.all(measured <= scene.robot.speed)


def test_actions_are_smooth(episodes, scene):
    """A jump in the speed of the command would show as a large second difference."""
    bend = np.abs(np.diff(episodes.action[..., :-1], 2, axis=1))
    assert bend.max() < 0.1  # rad per step^2


def test_state_follows_the_action(episodes):
    """A servo lags by damping / stiffness, 0.15 s; the expert stays below 1.5 rad/s."""
    lag = np.abs(episodes.state[:, 1:, :-1] - episodes.action[:, :-1, :-1])
    assert lag[valid(episodes)[:, 1:]].max() < 0.25  # rad


def test_images_show_the_episode(episodes):
    for picture in episodes.image.values():
        start, middle = picture[:, 0].astype(int), picture[:, 25].astype(int)
        assert np.all(np.abs(start - middle).max(axis=(1, 2, 3)) > 30)  # the hand moved
        assert np.abs(start - start[:1]).max() > 30  # layouts differ


def test_inverse_kinematics_reaches(robot_name):
    robot = getattr(robots, robot_name).ROBOT
    rng = np.random.default_rng(0)
    goals = jnp.array(rng.uniform([0.30, -0.18, 0.01], [0.42, 0.18, 0.12], (64, 3)), jnp.float32)
    way = route(*((goal, (0.0, 0.0, 0.0), 0.0, 1.0, 0.0) for goal in goals))
    rotations = expert.tool_rotations(robot, way)
    start = jnp.asarray(robot.home, jnp.float32)

    @jax.jit
    @jax.vmap
    def solve(goal, rotation):
        q = robots.inverse_kinematics(robot, goal, rotation, start)
        return q, *robots.tool_pose(robot, q)[:2]

    q, position, facing = solve(goals, rotations)
    assert np.all((q >= robot.lower) & (q <= robot.upper))
    np.testing.assert_allclose(position, goals, atol=2e-3)
    np.testing.assert_allclose(facing, rotations, atol=0.03)


def test_path_rests_at_every_knot_and_holds_the_last():
    knots, times = jnp.array([[0.0, 0.0], [1.0, -1.0], [1.0, 2.0]]), jnp.array([0.0, 1.0, 3.0])
    path = jax.jit(jax.vmap(expert.interpolate, in_axes=(None, None, 0)))
    found = np.asarray(path(knots, times, jnp.append(jnp.linspace(0.0, 3.0, 301), 99.0)))
    np.testing.assert_allclose(found[[0, 100, 300, 301]], np.asarray(knots)[[0, 1, 2, 2]])
    speed = np.diff(found[:-1], axis=0) / 0.01
    np.testing.assert_allclose(speed[[0, 99, 100, 299]], 0.0, atol=0.01)
    # The fastest moment of a minimum-jerk move is 1.875 times its mean speed.
    np.testing.assert_allclose(np.abs(speed).max(axis=0), [1.875, 1.875 * 3 / 2], rtol=1e-3)


@pytest.mark.slow
def test_hurried_experts_slow_down_to_half_the_speed_limits(env):
    def hurried(layout):
        way = env.task.waypoints(layout)
        return dataclasses.replace(way, seconds=jnp.full_like(way.seconds, 1e-3))

    quick = dataclasses.replace(env, task=dataclasses.replace(env.task, waypoints=hurried))
    plan = expert.plan(quick, env.reset(jax.random.key(0)), jax.random.key(1))
    fastest = 1.875 * np.abs(np.diff(plan.knots, axis=1)) / np.diff(plan.times)[..., None]
    share = fastest / env.robot.action_speed
    assert np.all(share[..., :-1] <= 0.5 + 1e-4)
    assert np.all(share[..., -1] <= 1 + 1e-4)
    assert np.all(share[:, 0].max(axis=-1) > 0.49)  # no slower than necessary


def numbered(success):
    """Replace the simulation: states are the numbers of the worlds."""

    def record(env, *arguments):
        episodes, _ = fake_record(env, *arguments)
        episodes["state"][:] = np.arange(env.num_envs)[:, None, None]
        return episodes, np.array(success)

    return record


def test_collect_keeps_successes_in_order(monkeypatch):
    monkeypatch.setattr(collection, "record_expert", numbered([True, False, True, True]))
    calls = []
    found = envs.collect(
        "press",
        num_episodes=5,
        num_envs=4,
        key=jax.random.key(0),
        progress=lambda *numbers: calls.append(numbers),
    )
    assert found.state[:, 0, 0].tolist() == [0, 2, 3, 0, 2]
    assert found.attempted == 7
    assert calls == [(0, 5), (3, 5), (5, 5)]


def test_collect_gives_up_on_a_broken_expert(monkeypatch):
    monkeypatch.setattr(collection, "record_expert", numbered([True, False, False, False]))
    with pytest.raises(ValueError, match="4 of 16"):
        envs.collect("press", num_episodes=50, num_envs=4, key=jax.random.key(0))
