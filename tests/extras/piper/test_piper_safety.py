"""Each check between a policy and the arm, alone."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import actions
from envs.robots import TIP_LENGTH, tool_pose
from envs.robots.piper import ROBOT, SDK_OFFSET
from lorasp_jax.extras.piper import safety
from lorasp_jax.extras.piper.interpolation import Path
from lorasp_jax.extras.piper.safety import Governor, Limits, Reading, Unsafe, check_chunk, fault

DT = 0.005
HOME = np.append(ROBOT.home, 0.04)
LIMITS = Limits.of()
FINE = Reading(HOME, age=0.0, driver_age=0.0, ctrl_mode=1, arm_status=0, enabled=True)


def shifted(joint, angle):
    return HOME + np.eye(7)[joint] * angle


def follow(governor, targets):
    """Return the commands [T, 7]."""
    return np.stack([governor.step(target) for target in targets])


def started(limits=LIMITS, pose=HOME):
    governor = Governor(limits, DT)
    governor.start(pose)
    return governor


def test_healthy_feedback_is_no_fault():
    assert fault(FINE, LIMITS) is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"age": 0.06}, "no feedback from the arm for 60 ms"),
        ({"age": np.inf}, "no feedback"),
        ({"pose": np.append(np.zeros(6), 0.01)}, "only zeros"),
        ({"pose": HOME * np.nan}, "only zeros"),
        ({"pose": shifted(3, np.pi)}, "joint 4 reports 180 degrees"),
        ({"arm_status": 7}, "status 7 (collision)"),
        ({"arm_status": 4}, "beyond the joint limits"),
        ({"arm_status": 99}, "status 99 (unknown)"),
        ({"ctrl_mode": 2}, "control mode 2 (teaching), not 1"),
        ({"ctrl_mode": 0}, "standby"),
        ({"enabled": False}, "driver is off"),
    ],
)
def test_faults_are_named(change, words):
    assert words in fault(FINE._replace(**change), LIMITS)


@pytest.mark.parametrize(
    "actions",
    [
        np.zeros((5, 8)),
        np.zeros(7),
        np.zeros((0, 7)),
        np.full((5, 7), "0"),
        np.zeros((5, 7), complex),
        None,
        np.append(np.zeros((4, 7)), np.full((1, 7), np.nan), axis=0),
        np.full((5, 7), np.inf),
    ],
)
def test_chunks_are_refused(actions):
    with pytest.raises(Unsafe, match="actions must be"):
        check_chunk(actions)


def test_chunk_passes():
    assert check_chunk(np.ones((5, 7), np.float32)).dtype == float


def test_targets_are_clamped_to_limits():
    wide = Limits.of(speed=3.0, box_low=(-9, -9, -9), box_high=(9, 9, 9))
    commands = follow(started(wide), [np.full(7, 10.0)] * 1200 + [np.full(7, -10.0)] * 600)
    assert (commands <= LIMITS.upper + 1e-9).all()
    assert (commands >= LIMITS.lower - 1e-9).all()
    np.testing.assert_allclose(commands.max(axis=0), LIMITS.upper)
    np.testing.assert_allclose(commands.min(axis=0), LIMITS.lower, atol=1e-9)


def test_limits_hold_in_both_conventions_of_zeros():
    both = Limits.of(zeros="sdk")
    for joints in (both.lower[:6], both.upper[:6]):
        assert (ROBOT.lower - 1e-6 <= joints - SDK_OFFSET).all()
        assert (joints - SDK_OFFSET <= ROBOT.upper + 1e-6).all()
        assert (ROBOT.lower - 1e-6 <= joints).all()
        assert (joints <= ROBOT.upper + 1e-6).all()
    assert Limits.of(zeros="urdf").lower[1] == 0.0


def test_speed_and_acceleration_are_limited():
    targets = [shifted(0, 0.05)] * 5 + [shifted(0, 0.8)] * 300 + [shifted(0, -0.8)] * 450
    commands = np.concatenate([HOME[None], follow(started(), targets)])
    velocity = np.diff(commands, axis=0) / DT
    change = np.diff(velocity, axis=0) / DT
    assert np.abs(velocity[:, :6]).max() == pytest.approx(1.0)
    assert np.abs(change[:, :6]).max() == pytest.approx(5.0)
    assert commands[-1, 0] == pytest.approx(-0.8, abs=1e-6)
    overshoot = commands[:, 0].max() - 0.8
    assert overshoot < 1e-6


def test_a_smooth_path_is_followed_without_lag():
    time = np.arange(0, 2, DT)
    path = [shifted(0, 0.5 * (1 - np.cos(1.5 * t))) for t in time]
    commands = follow(started(), path)
    assert np.abs(commands - path).max() < 1e-3


def test_a_far_first_target_is_approached_slowly():
    governor = started()
    far = shifted(0, 0.6)
    commands = follow(governor, [far] * 400)
    assert np.abs(np.diff(commands[:, 0]) / DT).max() == pytest.approx(0.2)
    assert governor.approaching
    follow(governor, [far] * 300)
    assert not governor.approaching


def test_a_first_target_beyond_the_limits_is_reached_at_the_limit():
    governor = started(pose=shifted(5, 1.9))
    follow(governor, [shifted(5, 3.0)] * 300)
    assert not governor.approaching
    assert governor.pose[5] == pytest.approx(LIMITS.upper[5])


def test_a_near_first_target_is_not():
    governor = started()
    governor.step(shifted(0, np.deg2rad(4.9)))
    assert not governor.approaching


def test_forward_kinematics_equal_the_simulations():
    pose = jax.jit(functools.partial(tool_pose, ROBOT))
    for joints in (ROBOT.home, ROBOT.lower * 0.5 + ROBOT.upper * 0.3):
        position, rotation, _ = pose(jnp.asarray(joints, jnp.float32))
        expected = position + TIP_LENGTH * rotation[:, 2]
        np.testing.assert_allclose(safety.finger_tips(joints), expected, atol=1e-6)


def test_finger_tips_stay_in_the_box():
    down = HOME + np.array([0, 0.6, 0, 0, 0, 0, 0])  # a lower shoulder, toward the table
    assert safety.outside(down[:6], LIMITS) > 0.02
    governor = started()
    commands = follow(governor, [down] * 600)
    assert governor.blocked
    assert max(safety.outside(pose[:6], LIMITS) for pose in commands) < 1e-4
    assert np.abs(np.diff(commands[-10:], axis=0)).max() == 0  # it stands still
    follow(governor, [HOME] * 500)
    np.testing.assert_allclose(governor.pose, HOME, atol=1e-6)  # and may go back


def test_from_outside_the_box_it_may_only_come_back():
    limits = dataclasses.replace(LIMITS, box_low=np.array([0.02, -0.45, 0.10]))
    low = HOME + np.array([0, 0.3, 0, 0, 0, 0, 0])
    assert safety.outside(low[:6], limits) > 0.02
    governor = started(limits, low)
    follow(governor, [low + np.array([0, 0.1, 0, 0, 0, 0, 0])] * 100)
    np.testing.assert_allclose(governor.pose, low)
    follow(governor, [HOME] * 500)
    np.testing.assert_allclose(governor.pose, HOME, atol=1e-6)


def test_braking_stops_within_the_acceleration_limit():
    governor = started()
    follow(governor, [shifted(0, 0.05)] * 5 + [shifted(0, 0.8)] * 100)
    before = governor.velocity.copy()
    poses = [governor.brake().copy() for _ in range(60)]
    assert before[0] > 0.9
    assert governor.velocity[0] == 0
    speeds = np.diff([p[0] for p in poses]) / DT
    assert np.abs(np.diff(speeds)).max() <= 5.0 * DT + 1e-9


def test_a_target_that_is_not_finite_is_refused():
    with pytest.raises(Unsafe, match="finite"):
        started().step(HOME * np.nan)


def test_wrong_settings_are_refused():
    for speed in (4, 0, -1, np.nan):
        with pytest.raises(ValueError, match=f"above 0 and at most 3 rad/s, got {speed}"):
            Limits.of(speed=speed)
    with pytest.raises(ValueError, match="must not be empty"):
        Limits.of(box_low=(0.7, 0.0, 0.0))


def test_path_interpolates_as_the_simulator():
    start, chunk = HOME, HOME + np.linspace(0, 0.3, 28).reshape(4, 7)
    path = Path(start, chunk, 0.1)
    interpolate = jax.jit(actions.interpolate, static_argnums=1)
    expected = np.array(interpolate(np.stack([start, start, chunk[0]]), 0.1, 0.0)[::4])  # per 20 ms
    expected[:, 6] *= 2  # the simulator's are of each finger
    ours = [path.target(seconds) for seconds in (0.02, 0.04, 0.06, 0.08, 0.1)]
    np.testing.assert_allclose(ours, expected, atol=1e-6)
    np.testing.assert_allclose(path.target(0.25), (chunk[1] + chunk[2]) / 2)
    np.testing.assert_allclose(path.target(9.0), chunk[-1])
    np.testing.assert_allclose(path.target(-1.0), start)
