"""Test the part of LeRobot's plugin between single targets and the arm, without LeRobot."""

import threading

import numpy as np
import pytest

from lorasp_jax.extras.piper.arms import PERIOD
from lorasp_jax.extras.piper.fake.timing import RealTime
from lorasp_jax.extras.piper.safety import Limits, Unsafe

LIMITS = Limits.of()
STEP = np.array([0.03, 0, 0, 0, 0, 0, 0])  # rad per action


@pytest.fixture(scope="module")
def module(load):
    return load("lerobot/lerobot_robot_lorasp_piper/follower.py")


@pytest.fixture
def follower(module, bench):
    return module.Follower(bench.arms, bench.clock, 0.1)


def moving(follower, bench):
    """Move for half a second; return the last target."""
    target = bench.arm.read().pose
    for _ in range(5):
        target = follower.follow(target + STEP)
        follower.run(0.1)
    return target


def sent(bench, monkeypatch):
    """Return a list that the commands from now on are added to."""
    commands, command = [], bench.arm.command
    monkeypatch.setattr(bench.arm, "command", lambda x: commands.append(x.copy()) or command(x))
    return commands


def test_it_reaches_each_target_within_a_control_step(follower, bench, monkeypatch):
    start, commands = bench.clock.now(), sent(bench, monkeypatch)
    target = moving(follower, bench)
    assert bench.clock.now() - start == pytest.approx(0.5)
    assert len(commands) == round(0.5 / PERIOD)
    np.testing.assert_allclose(commands[-1], target, atol=5e-3)
    speeds = np.diff(np.array(commands), axis=0)[:, 0] / PERIOD
    assert speeds.max() <= 1.0 + 1e-9  # while it makes up for the start
    np.testing.assert_allclose(speeds[-40:], 0.3, atol=1e-6)  # 0.03 rad in 0.1 s, evenly
    follower.run(0.5)
    np.testing.assert_allclose(follower.pose(), target, atol=0.02)  # it holds the last one
    assert bench.fake.unsafe == []


def test_targets_are_clipped_to_the_limits(follower, bench):
    far = np.full(7, 9.0)
    np.testing.assert_array_equal(follower.follow(far), LIMITS.upper)
    follower.run(2.0)
    assert bench.fake.unsafe == []


def test_a_target_that_is_no_number_is_refused(follower, bench):
    target = moving(follower, bench)
    with pytest.raises(Unsafe, match="finite"):
        follower.follow(np.where(np.arange(7) == 2, np.nan, target))
    follower.run(0.3)
    np.testing.assert_allclose(follower.pose(), target, atol=0.02)


def test_it_brakes_when_it_settles(follower, bench, monkeypatch):
    moving(follower, bench)
    commands = sent(bench, monkeypatch)
    follower.settle()
    speeds = np.diff(np.array(commands), axis=0)[:, 0] / PERIOD
    assert abs(speeds[-1]) < 1e-9
    assert np.abs(np.diff(speeds)).max() <= 5.0 * PERIOD + 1e-9  # rad/s², the firmware's default
    with pytest.raises(Unsafe, match="hold"):
        follower.follow(commands[-1])


@pytest.mark.parametrize(
    ("fault", "word"), [({"status": 7}, "collision"), ({"silent": True}, "feedback")]
)
def test_after_a_fault_it_holds_for_good(follower, bench, fault, word):
    target = moving(follower, bench)
    for name, value in fault.items():
        setattr(bench.fake.faults, name, value)
    follower.follow(target + STEP)
    follower.run(0.5)
    for name in fault:
        setattr(bench.fake.faults, name, type(fault[name])())
    held = follower._arms.pose.copy()
    for ask in (follower.pose, lambda: follower.follow(target)):
        with pytest.raises(Unsafe, match=word):
            ask()
    follower.run(0.5)
    np.testing.assert_array_equal(follower._arms.pose, held)


def test_an_error_of_its_thread_is_told(follower, bench, monkeypatch):
    moving(follower, bench)
    with monkeypatch.context() as patch:
        patch.setattr(bench.arm, "read", lambda: next(iter(())))
        with pytest.raises(StopIteration):
            follower.run()
    assert not follower._arms.moving, "it has braked"
    with pytest.raises(Unsafe, match="StopIteration"):
        follower.pose()


@pytest.mark.usefixtures("patient")
def test_it_runs_in_a_thread_until_it_is_stopped(module, bench):
    clock = RealTime(bench.fake)
    bench.arm._clock = clock
    clock.start(bench.arm)
    clock.wait_until(clock.now() + 0.3)  # until each kind of frame has come by this clock
    try:
        follower = module.Follower(bench.arms, clock, 0.1)
        thread = threading.Thread(target=follower.run)
        thread.start()
        target = follower.follow(follower.pose() + STEP)
        clock.wait_until(clock.now() + 1.0)
        np.testing.assert_allclose(follower.pose(), target, atol=0.02)
        follower.stop()
        thread.join(10)
        assert not thread.is_alive()
        follower.settle()
    finally:
        clock.stop()
