"""The arm's driver and the fake arm, through the unmodified piper_sdk on a virtual CAN bus."""

import can
import numpy as np
import pytest

from lorasp_jax.extras.piper.arm import PiperArm
from lorasp_jax.extras.piper.fake import frames
from lorasp_jax.extras.piper.safety import (
    MAX_AGE,
    MAX_DRIVER_AGE,
    MAX_EFFORT,
    Governor,
    Limits,
    Unsafe,
    fault,
    finger_tips,
)
from tests.extras.piper.benches import Bench, channel

LIMITS = Limits.of()


@pytest.fixture
def bench(world):
    bench = Bench(world)
    yield bench.arm, bench.fake, bench.clock
    bench.close()


def ready(bench):
    arm, fake, clock = bench
    arm.connect()
    arm.enable(LIMITS)
    return arm, fake, clock


def wait(clock, seconds):
    clock.wait_until(clock.now() + seconds)


def drive(arm, clock, target, ticks):
    governor = Governor(LIMITS, 0.005)
    governor.start(arm.read().pose)
    for _ in range(ticks):
        arm.command(governor.step(target))
        wait(clock, 0.005)


def test_feedback_is_in_the_simulations_units_and_zeros(bench):
    arm, fake, _ = bench
    arm.connect()
    np.testing.assert_allclose(arm.read().pose, fake.world.pose, atol=1e-3)
    assert arm.read().ctrl_mode == 0
    assert not arm.read().enabled


def test_the_arm_moves_where_it_is_told_and_only_there(bench):
    arm, fake, clock = ready(bench)
    assert fault(arm.read(), LIMITS) is None
    target = fake.world.pose + np.array([0.3, 0.1, -0.2, 0.1, -0.1, 0.2, -0.02])
    drive(arm, clock, target, 500)
    np.testing.assert_allclose(fake.world.pose, target, atol=5e-3)
    assert fake.unsafe == []


def test_enabling_does_not_move_the_arm(bench):
    before = bench[1].world.pose
    _, fake, _ = ready(bench)
    np.testing.assert_allclose(fake.world.pose, before, atol=2e-3)


def test_enabling_again_does_not_return_to_an_earlier_target(bench):
    arm, fake, clock = ready(bench)
    drive(arm, clock, fake.world.pose + np.array([0.4, 0, 0, 0, 0, 0, 0]), 200)
    arm.disable()
    wait(clock, 0.1)
    fake.world.data.qpos[0] -= 0.6  # a person pushes the powerless arm
    wait(clock, 0.05)
    before = fake.world.pose
    arm.enable(LIMITS)
    wait(clock, 0.5)
    np.testing.assert_allclose(fake.world.pose[0], before[0], atol=5e-3)  # the others have fallen
    assert fake.unsafe == []


def test_the_speed_percentage_limits_the_arm_too(bench):
    arm, fake, clock = ready(bench)
    start = fake.world.pose
    for _ in range(40):  # without a governor: one far target
        arm.command(start + np.array([1.0, 0, 0, 0, 0, 0, 0]))
        wait(clock, 0.005)
    assert fake.world.pose[0] - start[0] < 0.2 * 1.02  # 34 % of 3 rad/s for 0.2 s


def test_commands_take_the_latency(world):
    moved = []
    for latency in (0.0, 0.15):
        bench = Bench(world, latency=latency).ready()
        bench.wait(0.3)
        start = world.pose
        drive(bench.arm, bench.clock, start + np.array([0.3, 0, 0, 0, 0, 0, 0]), 40)
        moved.append(world.pose[0] - start[0])
        bench.close()
    assert moved[0] > 0.02
    assert moved[1] < moved[0] / 4


def test_a_new_layout_starts_at_its_start_pose_whatever_was_commanded_before(bench):
    arm, fake, clock = ready(bench)
    arm.command(fake.world.pose + np.array([0.5, 0, 0, 0, 0, 0, -0.02]))
    clock.reset(5)
    start = fake.world.pose
    wait(clock, 0.3)
    np.testing.assert_allclose(fake.world.pose, start, atol=2e-3)


def test_frames_that_stop_are_noticed_within_60_ms(bench):
    arm, fake, clock = ready(bench)
    fake.faults.silent = True
    wait(clock, 0.045)
    assert fault(arm.read(), LIMITS) is None
    wait(clock, 0.015)
    assert "no feedback from the arm" in fault(arm.read(), LIMITS)
    fake.faults.silent = False
    wait(clock, 0.01)
    assert fault(arm.read(), LIMITS) is None


@pytest.mark.parametrize("kind", [*frames.JOINTS, frames.GRIPPER, *frames.DRIVERS])
def test_every_kind_of_frame_must_come(world, kind):
    bench, words = Bench(world).ready(), "no feedback"
    slack = 0.0
    if kind in frames.DRIVERS:
        words, slack = "no state of a joint's driver", MAX_DRIVER_AGE - MAX_AGE
    bench.lose({kind})
    bench.wait(slack)
    assert fault(bench.arm.read(), LIMITS) is None
    bench.wait(MAX_AGE + 0.01)
    assert words in fault(bench.arm.read(), LIMITS)
    bench.close()


def test_frames_that_the_sdk_refuses_are_no_feedback(bench):
    arm, fake, clock = ready(bench)
    send = fake._send

    def implausible(kind, data):
        fake.stamp += 1e-6  # each frame of a real bus has a stamp of its own
        send(kind, frames.pair(4e6, 0) if kind == frames.JOINTS[1] else data)

    fake._send = implausible
    wait(clock, 0.06)
    assert "no feedback" in fault(arm.read(), LIMITS)


def test_an_arm_that_lacks_a_kind_of_frame_is_refused(world):
    bench = Bench(world)
    bench.lose({frames.GRIPPER})
    with pytest.raises(ConnectionError, match="does not send 0x2a8:"):
        bench.arm.connect(timeout=0.1)
    bench.close()


def test_clock_steps_do_not_age_feedback(bench):
    arm, fake, clock = ready(bench)
    for step in (-1000.0, 1000.0, 0.0):
        fake.faults.clock_step = step
        wait(clock, 0.02)
        assert fault(arm.read(), LIMITS) is None
    fake.faults.silent, fake.faults.clock_step = True, -1000.0
    wait(clock, 0.06)
    assert "no feedback" in fault(arm.read(), LIMITS)


@pytest.mark.parametrize(
    ("faults", "error", "words"),
    [
        ({"zeros": True}, Unsafe, "only zeros"),
        ({"status": 6}, Unsafe, "brake"),
        ({"dead_driver": 2}, ConnectionError, "drivers are not on"),
        ({"ctrl_mode": 2}, ConnectionError, "stays in control mode 2"),
    ],
)
def test_enabling_refuses_a_faulty_arm(bench, faults, error, words):
    arm, fake, _ = bench
    vars(fake.faults).update(faults)
    arm.connect()
    with pytest.raises(error, match=words):
        arm.enable(LIMITS, timeout=0.2)
    if error is Unsafe:
        assert fake.commands == 0
        assert not fake._enabled.any()


def test_corrupted_firmware_limits_are_refused(bench):
    arm, fake, _ = bench
    fake.faults.corrupted = True
    with pytest.raises(Unsafe, match="limits of joint 1 are corrupted"):
        arm.connect()


def test_a_missing_interface_is_one_sentence(capsys):
    with pytest.raises(
        ConnectionError, match=r"cannot open can_nowhere: .*can_activate.sh can_nowhere"
    ):
        PiperArm("can_nowhere")
    assert capsys.readouterr() == ("", "")


def test_the_grippers_effort_is_capped():
    with pytest.raises(ValueError, match=f"at most {MAX_EFFORT}, got 5000"):
        PiperArm(channel(), bus="virtual", effort=5000)


def test_the_gripper_frame_has_the_effort(bench, monkeypatch):
    efforts, unpack = [], frames.unpack_gripper

    def spy(data):
        efforts.append(unpack(data)[1])
        return unpack(data)

    monkeypatch.setattr(frames, "unpack_gripper", spy)
    arm, fake, clock = ready(bench)
    drive(arm, clock, fake.world.pose, 5)
    assert set(efforts) == {1000}  # the default, below MAX_EFFORT


def test_nan_never_reaches_the_bus(bench):
    arm, fake, clock = ready(bench)
    sent = fake.commands
    with pytest.raises(Unsafe, match="finite"):
        arm.command(np.full(7, np.nan))
    wait(clock, 0.01)
    assert fake.commands == sent


def test_the_fake_arm_notices_what_a_client_must_not_send(bench):
    arm, fake, clock = ready(bench)
    arm.sdk.JointCtrl(200_000, 0, 0, 0, 0, 0)
    arm.sdk.GripperCtrl(90_000, 1000, 0x01, 0)
    arm.sdk.MotionCtrl_2(0x01, 0x01, 30, 0xAD)
    arm.sdk.EmergencyStop(0x01)
    wait(clock, 0.02)
    text = " ".join(fake.unsafe)
    for words in ("joints 1-2", "gripper 90", "MIT", "emergency stop"):
        assert words in text
    assert arm.read().arm_status == 1


def test_frames_have_eight_bytes():
    made = [frames.pair(-1, 2), frames.gripper(7e4, 0, True), frames.status(1, 0, 0)]
    made += [frames.driver(True), frames.firmware_limits(6, -120, 120, 3)]
    assert {len(frame) for frame in made} == {8}
    assert frames.unpack_pair(frames.pair(-90_000, 1)) == (-90_000, 1)


def send(fake, kind, *data):
    data = bytes([*data, *[0] * (8 - len(data))])
    fake._obey(can.Message(arbitration_id=kind, data=data, is_extended_id=False))


@pytest.mark.parametrize(
    ("frame", "status", "seconds"),
    [
        ((frames.STOP_OR_TEACH, 1), 1, 0.8),
        ((frames.STOP_OR_TEACH, 2), 0, 0.15),
        ((frames.ENABLE, 7, 1), 0, 0.15),
    ],
    ids=["emergency stop", "reset", "disable"],
)
def test_the_fake_arm_sinks_at_a_stop_and_falls_without_power(bench, frame, status, seconds):
    """By 10 cm, in a time that tells sinking from falling."""
    arm, fake, clock = ready(bench)
    wait(clock, 0.05)  # until all that the arm was told has arrived
    height = finger_tips(fake.world.pose[:6])[2]
    send(fake, *frame)
    wait(clock, 0.6 * seconds)
    assert finger_tips(fake.world.pose[:6])[2] > height - 0.1
    wait(clock, 0.8 * seconds)
    assert finger_tips(fake.world.pose[:6])[2] < height - 0.1
    reading = arm.read()
    assert (reading.arm_status, reading.enabled) == (status, status == 1)
    send(fake, frames.STOP_OR_TEACH, 2)  # ends the stop, too
    wait(clock, 2.0)
    arm.enable(LIMITS)
    before = fake.world.pose
    wait(clock, 0.3)
    np.testing.assert_allclose(fake.world.pose, before, atol=5e-3)
