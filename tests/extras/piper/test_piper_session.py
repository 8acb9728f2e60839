"""The control loop on the fake arm, through the unmodified piper_sdk: execution."""

import json
import signal
import types
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image
from websockets.exceptions import ConcurrencyError

from lorasp_jax.extras.piper import log as logs
from lorasp_jax.extras.piper import session as sessions
from lorasp_jax.extras.piper.asking import InThread
from lorasp_jax.extras.piper.keys import SIGNALS
from lorasp_jax.extras.piper.log import Log
from lorasp_jax.extras.piper.options import stop_on_signals
from lorasp_jax.extras.piper.session import PERIOD
from lorasp_jax.extras.piper.settings import Settings
from lorasp_jax.extras.serving.client import PolicyError, ServerGone
from lorasp_jax.extras.serving.wire import FrameError
from tests.cases import mostly_slow
from tests.extras.piper.benches import Bench
from tests.extras.piper.piper_runs import ARM_STEP, Run, Turning, assert_braked, assert_safe


def test_actions_are_executed_at_their_pace(bench):
    run = Run(bench, ask := Turning())
    start = bench.world.pose[0]
    assert run(1.0) is None
    bench.wait(0.5)  # until the servos have caught up
    assert bench.world.pose[0] - start == pytest.approx(10 * 0.03, abs=0.012)
    assert len(ask.asked) == 2
    assert run.session.chunks == 2
    assert_safe(run)


def test_the_policy_sees_the_arms_state_and_pictures(bench):
    run, before = Run(bench, ask := Turning()), bench.world.pose
    run(0.1)
    observation = ask.asked[0]
    np.testing.assert_allclose(observation["state"], before, atol=2e-3)
    assert observation["state"].dtype == np.float32
    assert observation["prompt"] == "turn"
    assert {name: x.shape for name, x in observation["image"].items()} == {
        "side": (16, 16, 3),
        "wrist": (16, 16, 3),
    }


def test_the_arm_waits_for_a_slow_answer(bench):
    run = Run(bench, ask := Turning(), latency=0.3)
    run(1.6)  # twice 0.3 s of thinking and 0.5 s of acting
    assert len(ask.asked) == 2
    assert_safe(run)


def test_asking_ahead_skips_what_is_past(bench):
    start = bench.clock.now()
    answers, keys = [], []

    def ask(observation):
        """Actions that say for which time they are."""
        keys.append((observation.get("executed"), observation.get("delay")))
        now = bench.clock.now() - start
        answers.append(now)
        times = now + 0.1 * np.arange(1, 11)
        return base + times[:, None] * ARM_STEP / 0.1

    base = bench.arm.read().pose
    run = Run(bench, ask, latency=0.2, settings={"ahead": 3})
    run(2.0)
    assert keys == [(None, None)] + [(5, 3)] * (len(keys) - 1)
    assert np.diff(answers)[1:] == pytest.approx(0.5, abs=0.011)
    times = np.arange(len(run.path)) * PERIOD
    late = times > 1.2  # the first chunk could not be asked for ahead
    expected = base[0] + times[late] * 0.3
    np.testing.assert_allclose(run.path[late, 0], expected, atol=0.004)


@pytest.mark.parametrize(
    "case",  # latency [s], delay and wait [control steps]
    mostly_slow([(0.0, 0, 0), (0.2, 2, 0), (0.16, 2, 0), (0.5, 3, 2)], [(0.16, 2, 0), (0.5, 3, 2)]),
    ids=str,
)
def test_a_new_chunk_takes_over_as_in_the_simulation(bench, case):
    """It starts where the previous one was, at the end of an action, even if they disagree."""
    latency, delay, wait = case
    chunks, targets, recorded = [], [], []
    base = bench.arm.read().pose[0]

    def ask(observation):
        chunk = np.tile(observation["state"], (8, 1))
        chunk[:, 0] = base + 0.001 * (len(chunks) + 0.1) * np.arange(1, 9)
        chunks.append(chunk[:, 0])
        return chunk

    recorder = types.SimpleNamespace(step=lambda images, state, action: recorded.append(action[0]))
    run = Run(bench, ask, latency=latency, settings={"ahead": 3}, recorder=recorder)
    step = run.session._arms.step
    run.session._arms.step = lambda target: targets.append(target[0]) or step(target)
    run(latency + 1.5)
    parts = [chunks[0][: 5 + delay], *(chunk[delay : 5 + delay] for chunk in chunks[1:])]
    waits = [np.repeat(part[-1], wait) for part in parts]
    actions = np.concatenate([x for both in zip(parts, waits, strict=True) for x in both])
    first, last = 0.1, 1.4  # s; the way to the first action depends on where the arm was
    times = np.arange(first, last, PERIOD)
    expected = np.interp(times, 0.1 * np.arange(1, 1 + len(actions)), actions)
    np.testing.assert_allclose(targets[round(first / PERIOD) :][: len(times)], expected, atol=1e-6)
    np.testing.assert_array_equal(recorded, np.concatenate(parts)[: len(recorded)])


def test_targets_beyond_the_limits_are_clamped(bench):
    ask = Turning()
    ask.change = lambda actions: actions + np.array([0, 0, 0, 0, 0, 0, 0.5])
    assert Run(bench, ask)(1.0) is None
    assert bench.world.pose[6] == pytest.approx(0.07, abs=1e-3)
    assert bench.fake.unsafe == []


def test_a_far_first_target_is_approached_slowly_before_the_chunk_begins(bench):
    ask = Turning()
    ask.change = lambda actions: actions + np.array([0.3, 0, 0, 0, 0, 0, 0])
    run = Run(bench, ask, settings={"execute": 10})
    start = bench.world.pose[0]
    run(1.0)
    speed = np.abs(np.diff(run.path[:, 0])).max() / PERIOD
    assert speed <= 0.2 + 1e-9
    assert run.session.chunks == 1
    assert bench.world.pose[0] - start < 0.25


@pytest.mark.usefixtures("near_rest")
def test_a_first_target_out_of_reach(bench, monkeypatch):
    monkeypatch.setattr(sessions, "_APPROACH_TIME", 1.0)
    ask = Turning()
    ask.change = lambda actions: actions + np.array([0, 1.0, 0, 0, 0, 0, 0])  # below the table
    run = Run(bench, ask)
    assert "the first action is out of reach" in run(60.0)
    assert_safe(run)


@pytest.mark.parametrize("number", mostly_slow(SIGNALS, [signal.SIGTERM]))
def test_signals_brake_and_hold(bench, number):
    handlers = {each: signal.getsignal(each) for each in SIGNALS}
    run = Run(bench, Turning())
    run.at = {0.5: lambda: signal.raise_signal(number)}
    start = bench.world.pose
    try:
        stop_on_signals(run.session)
        assert run(30.0) is None
    finally:
        for each, handler in handlers.items():
            signal.signal(each, handler)
    assert run.session.stopped
    assert run.said == ["stopped"]  # it does not move to rest
    assert bench.clock.now() < 3.0
    bench.wait(0.5)
    assert 0.1 < bench.world.pose[0] - start[0] < 0.25
    assert_braked(run)


def test_a_dry_run_sends_nothing(world):
    bench = Bench(world)
    bench.arm.connect()
    before = world.pose
    run = Run(bench, ask := Turning(), settings={"dry_run": True})
    assert run(0.5) is None
    assert bench.fake.commands == 0
    assert 4 <= len(run.said) <= 6
    assert run.said[0].startswith("would command")
    assert len(ask.asked) == 1
    np.testing.assert_allclose(world.pose, before, atol=2e-3)
    bench.close()


def test_the_log_has_every_observation_chunk_and_command(bench, tmp_path):
    log = Log(tmp_path)
    Run(bench, Turning(), log=log)(0.6)
    log.close()
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert sum("observation" in line for line in lines) == 2
    assert sum("chunk" in line for line in lines) == 2
    assert sum("command" in line for line in lines) >= 120
    image = np.asarray(Image.open(tmp_path / "000001_wrist.png"))
    assert image.shape == (16, 16, 3)
    with pytest.raises(ValueError, match="already has a log"):
        Log(tmp_path)


@pytest.mark.parametrize("full", [True, False])
def test_a_log_that_cannot_be_written_says_so_at_the_end(full, tmp_path, monkeypatch):
    if full:
        file = open("/dev/full", "w")  # noqa: SIM115
        monkeypatch.setattr(logs, "open", lambda *_: file, raising=False)
    log = Log(tmp_path)
    log.line(0.0, value=1 if full else object())  # a full disk shows when the file is closed
    with pytest.raises(OSError, match="No space left" if full else "float"):
        log.close()


@pytest.mark.parametrize("name", ["control_dt", "patience", "hold"])
@pytest.mark.parametrize("value", [0.0, -0.1, np.nan, np.inf])
def test_times_must_be_positive_and_finite(name, value):
    with pytest.raises(ValueError, match=f"{name} must be .* got {value}"):
        Settings("turn", **{name: value})


def test_asking_in_a_thread(bench):
    asker = InThread(Turning())
    asker.ask({"state": np.zeros(7)})
    asker._thread.join()
    assert asker.answer().shape == (10, 7)

    for error in (ServerGone, FrameError, TypeError, ConcurrencyError):
        asker = InThread(Mock(side_effect=error("gone")))
        asker.ask({})
        asker._thread.join()
        with pytest.raises(PolicyError, match="gone"):
            asker.answer()


def test_after_an_episode_the_arm_goes_home_slowly(bench):
    start = bench.arm.read().pose
    run = Run(bench, Turning())
    assert run(1.5) is None
    moved = bench.world.pose[0] - start[0]
    assert moved > 0.2
    sent, begin = len(run.sent), bench.clock.now()
    assert run.session.home(start) is None
    assert run.said == ["moving slowly to the start pose"]
    bench.wait(0.3)
    np.testing.assert_allclose(bench.world.pose[:6], start[:6], atol=0.02)
    speed = np.abs(np.diff(np.stack(run.sent[sent:])[:, 0])).max() / PERIOD
    assert 0.1 < speed <= 0.2 + 1e-9
    assert bench.clock.now() - begin > 1.0
    assert_safe(run)


@pytest.mark.parametrize("stopped", [True, False])
def test_the_way_home_ends_where_something_prevents_it(bench, stopped):
    start = bench.arm.read().pose
    run = Run(bench, Turning())
    assert run(1.5) is None
    command, end = bench.arm.command, bench.clock.now() + 0.4

    def prevent(pose):
        command(pose)
        if bench.clock.now() > end:
            run.session.stop() if stopped else vars(bench.fake.faults).update(status=7)

    bench.arm.command = prevent
    problem = run.session.home(start)
    assert (problem is None) if stopped else "collision" in problem
    assert run.said[1:] == ["stopped" if stopped else f"holding: {problem}"]
    assert bench.world.pose[0] > start[0] + 0.05
