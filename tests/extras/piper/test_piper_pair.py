"""Two arms: one session drives both, and what goes wrong with one holds both."""

import dataclasses

import jax
import numpy as np
import pytest

from lorasp_jax.data.lerobot_export import to_lerobot
from lorasp_jax.data.opening import open_source
from lorasp_jax.extras.piper.arms import SIDES, Arms, dimension_names
from lorasp_jax.extras.piper.recording import Recording
from lorasp_jax.extras.piper.safety import Limits
from lorasp_jax.extras.piper.teaching import Lesson
from lorasp_jax.training.loop import train
from lorasp_jax.training.run_folder import read_metrics
from tests.cases import mostly_slow
from tests.extras.piper.benches import Bench
from tests.extras.piper.piper_runs import (
    ARM_STEP,
    Run,
    Turning,
    assert_braked,
    assert_holds,
    assert_safe,
)
from tests.training.test_two_arms import prepare

STEPS = np.arange(1, 11)[:, None]
WAYS = {"task": "turn", "instructions": (), "prompt": "turn", "control_dt": 0.1}
WAYS |= {"robot": "bi_piper", "names": dimension_names(SIDES), "image_size": 16}


def bases(bench):
    return np.array([limb.pose[0] for limb in bench.world.limbs.values()])


def test_one_policy_moves_both_arms(pair):
    ask, start = Turning(), bases(pair)
    ask.change = lambda actions: actions - 2 * ARM_STEP[0] * STEPS * np.eye(14)[7]  # the right base
    run = Run(pair, ask)
    assert run(1.0) is None
    pair.wait(0.5)
    np.testing.assert_allclose(bases(pair) - start, [0.3, -0.3], atol=0.02)
    observation = ask.asked[0]
    assert observation["state"].shape == (14,)
    assert sorted(observation["image"]) == ["cam_high", "cam_left_wrist", "cam_right_wrist"]
    assert_safe(run)


FAULTS = {"collision": {"status": 7}, "no feedback": {"silent": True}}
FAULTS |= {"only zeros": {"zeros": True}, "driver is off": {"dead_driver": 1}}
CASES = [(words, index) for words in FAULTS for index in (0, 1)]


@pytest.mark.parametrize("case", mostly_slow(CASES, [("collision", 0), ("no feedback", 1)]))
def test_a_fault_of_one_arm_holds_both(pair, case):
    words, index = case

    def fail():
        vars(pair.fakes[index].faults).update(FAULTS[words])
        for fake in pair.fakes:
            fake._tick = -1  # the drivers' states, every tenth time, come next

    run = Run(pair, Turning())
    run.at = {0.5: fail}
    problem = run(5.0)
    assert problem.startswith(f"{SIDES[index]} arm: ")
    assert words in problem
    assert_holds(run, words, jump=0.03)
    assert_braked(run, [1 - index], 0.03)  # the other one brakes, and does not stop at once
    assert (bases(pair) < 0.3).all()


def test_both_go_on_after_a_short_gap_of_one(pair):
    run = Run(pair, Turning(), hold=5.0)
    run.at = {
        0.5: lambda: vars(pair.fakes[1].faults).update(silent=True),
        0.9: lambda: vars(pair.fakes[1].faults).update(silent=False),
    }
    assert run(1.5) is None
    assert "right arm: no feedback" in run.said[0]
    assert run.said[1] == "going on"
    assert_safe(run)


def test_an_arm_that_a_person_takes_is_left_alone_and_the_other_holds(pair):
    run = Run(pair, Turning())
    run.at = {0.5: lambda: pair.drivers[0].teach(True)}
    assert "left arm: the arm is in control mode 2 (teaching)" in run(5.0)
    sent = pair.fakes[0].commands
    assert_holds(run, "teaching", jump=0.03)
    assert_braked(run, [1], 0.03)
    assert pair.fakes[0].commands == sent < 120 < pair.fakes[1].commands


@pytest.mark.parametrize("part", ["command", "read"])
def test_a_bus_that_breaks_does_not_stop_the_brake_of_the_other_arm(pair, part, monkeypatch):
    due = pair.clock.now() + 0.45

    def work(*arguments):
        if pair.clock.now() > due:
            raise OSError("it broke")
        return original(*arguments)

    original = getattr(pair.drivers[0], part)
    monkeypatch.setattr(pair.drivers[0], part, work)
    run = Run(pair, Turning())
    with pytest.raises(OSError, match="it broke"):
        run(30.0)
    assert run.said == ["holding: it broke"]
    assert_braked(run, [1])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda actions: actions[:, :7], r"actions must be numbers [C, 14], got float64 [10, 7]"),
        (lambda actions: np.where(np.arange(14) == 9, np.nan, actions), "actions must be finite"),
    ],
)
def test_chunks_for_other_arms_are_refused(pair, change, words):
    run = Run(pair, ask := Turning())
    run.at = {0.4: lambda: setattr(ask, "change", change)}
    assert words in run(0.8)
    assert_braked(run)


def test_warnings_name_the_arm(pair):
    run = Run(pair, ask := Turning())
    ask.change = lambda actions: actions + 0.9 * np.eye(14)[13]
    run(0.6)
    assert run.said[0].startswith("warning: right arm: all actions of the gripper are far beyond")


def test_both_go_home_but_not_to_rest_by_themselves(pair):
    start = pair.arms.read()
    run = Run(pair, ask := Turning())
    assert run(0.8) is None
    assert run.session.home(start) is None
    pair.wait(0.3)
    np.testing.assert_allclose(bases(pair), start[[0, 7]], atol=0.02)
    run = Run(pair, ask)
    ask.change = lambda actions: actions[:, :3]
    assert "actions must be numbers" in run(5.0)
    np.testing.assert_allclose(bases(pair), start[[0, 7]], atol=0.02)


def test_the_box_stops_both(pair):
    """An arm that the box blocks must not be pulled on by the other."""
    start = pair.arms.read()
    pair.arms.start(start)
    one = pair.arms._governors[0]
    for tick in range(200):
        if tick == 100:
            low, high = np.full(3, -9.0), np.array([9.0, -5.0, 9.0])  # ever farther away
            one.limits = dataclasses.replace(one.limits, box_low=low, box_high=high)
        pair.arms.step(start + 0.005 * tick * np.eye(14)[[0, 7]].sum(0))
        if tick == 99:
            assert pair.arms.moving
    assert one.blocked
    assert not pair.arms.moving


def test_an_arm_that_sinks_without_its_drivers_does_not_jump_back(pair):
    pair.fakes[1].faults.dead_driver = 2
    pair.wait(0.2)
    for angle in (0.1, 0.2):
        pair.arms.read()
        reading = pair.arms._latest[1]
        sunk = reading._replace(pose=reading.pose + angle * np.eye(7)[1])
        assert not sunk.enabled
        pair.arms._latest[1] = sunk
        pair.arms.yield_to_faults()
        np.testing.assert_array_equal(pair.arms.pose[7:], sunk.pose)


def test_arms_keep_their_order_if_one_could_not_be_read_at_first(table, monkeypatch):
    bench = Bench(table).ready()
    expected, read = bench.arms.read(), bench.drivers[0].read
    arms = Arms({"left": bench.drivers[0], "right": bench.drivers[1]}, Limits.of())
    with monkeypatch.context() as patch:
        patch.setattr(bench.drivers[0], "read", lambda: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            arms.read()
    assert bench.drivers[0].read == read
    np.testing.assert_allclose(arms.read(), expected, atol=2e-3)
    bench.close()


def test_both_are_guided_by_hand(pair, tmp_path):
    recorder = Recording(tmp_path / "data", **WAYS)
    lesson = Lesson(pair.arms, pair.world.images, recorder, pair.clock, way="hand", control_dt=0.1)
    starts, begin = [fake.limb.pose for fake in pair.fakes], pair.clock.now()

    def guide():
        turn = 0.2 * max(0.0, pair.clock.now() - begin - 0.3) * np.eye(7)[0]
        for fake, start, way in zip(pair.fakes, starts, (1, -1), strict=True):
            fake.hand = start + way * turn
        return False

    lesson.run(1.5, guide)
    recorder.keep()
    action = open_source(tmp_path / "data").episode(0).action[0]
    assert action.shape[1] == 14
    np.testing.assert_allclose(action[-1, 0], -action[-1, 7], atol=0.01)
    assert action[-1, 0] > 0.1


def test_an_error_while_enabling_names_the_arm(table):
    bench = Bench(table)
    bench.arms.connect()
    bench.fakes[1].faults.status = 7
    bench.wait(0.1)
    with pytest.raises(ValueError, match=r"right arm: .*collision.*the left arm is on"):
        bench.arms.enable()
    bench.close()


def test_recordings_are_two_armed_datasets(pair, tmp_path):
    """In this project's format and LeRobot's, both grippers are known by their names."""
    names = WAYS["names"]
    assert names[::6] == ["left_joint_1.pos", "left_gripper.pos", "right_joint_6.pos"]
    recorder = Recording(tmp_path / "data", **WAYS)
    run = Run(pair, Turning(), recorder=recorder)
    assert run(1.0) is None
    recorder.keep()
    source = open_source(tmp_path / "data")
    to_lerobot(source, tmp_path / "lerobot", lambda done, total: None)
    for found in (source, open_source(tmp_path / "lerobot")):
        assert found.names == {"state": names, "action": names}
        assert found.grippers == {"state": [6, 13], "action": [6, 13]}
        episode = found.episode(0)
        assert episode.robot == "bi_piper"
        assert episode.state.shape == episode.action.shape == (1, 10, 14)
    with pytest.raises(ValueError, match=r"has names \['left_joint_1.pos'.* choose another folder"):
        Recording(tmp_path / "data", **WAYS | {"robot": "piper", "names": ()})


@pytest.mark.slow
def test_recordings_train(pair, tmp_path, monkeypatch):
    """Relative actions spare both grippers, as their names say."""
    recorder = Recording(tmp_path / "data", **WAYS)
    for _ in range(3):
        assert Run(pair, Turning(), recorder=recorder)(1.0) is None
        recorder.keep()
    cameras = ("cam_high", "cam_left_wrist", "cam_right_wrist")
    run = prepare(tmp_path / "run", monkeypatch, tmp_path / "data", cameras, relative=True)
    assert run.policy.processor.inputs.delta == (*[True] * 6, False) * 2
    run.devices = jax.devices()[:1]
    train(run)
    assert read_metrics(run.folder)[-1]["step"] == 2
