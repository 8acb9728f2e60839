"""The control loop on the fake arm when the arm, the server or a camera fails."""

import contextlib
import itertools
import signal
import types

import numpy as np
import pytest
from websockets.exceptions import ConcurrencyError

from lorasp_jax.base.errors import describe_any
from lorasp_jax.extras.piper.cameras import NoPicture
from lorasp_jax.extras.piper.fake import frames
from lorasp_jax.extras.piper.keys import SIGNALS
from lorasp_jax.extras.piper.log import Log
from lorasp_jax.extras.piper.options import stop_on_signals
from lorasp_jax.extras.piper.remote import Server
from lorasp_jax.extras.piper.session import PERIOD
from lorasp_jax.extras.serving.client import PolicyClient, PolicyError
from lorasp_jax.extras.serving.wire import FrameError
from tests.cases import mostly_slow
from tests.extras.piper.piper_runs import Run, Turning, assert_braked, assert_holds, assert_safe
from tests.extras.serving.stand_in import StandIn, serving


def test_frames_that_stop_for_a_while(bench):
    run = Run(bench, Turning(), hold=5.0)
    run.at = {
        0.5: lambda: vars(bench.fake.faults).update(silent=True),
        0.9: lambda: vars(bench.fake.faults).update(silent=False),
    }
    assert run(1.5) is None
    assert "no feedback from the arm" in run.said[0]
    assert run.said[1] == "going on"
    still = run.path[int(0.8 / PERIOD) : int(0.89 / PERIOD)]
    assert np.ptp(still, axis=0).max() == 0
    assert_safe(run)


def test_frames_that_stop_for_good(bench):
    run = Run(bench, Turning())
    run.at = {0.5: lambda: vars(bench.fake.faults).update(silent=True)}
    assert "no feedback" in run(5.0)
    assert bench.clock.now() < 3.0
    assert_holds(run, "no feedback from the arm")


@pytest.mark.parametrize("push", [0.0, 0.3])
def test_after_a_short_gap_the_arm_brakes_to_the_end_and_goes_on_from_there(bench, push):
    run = Run(bench, Turning(), hold=5.0)

    def resume():
        bench.fake.faults.silent = False
        bench.world.data.qpos[0] += push  # meanwhile somebody has moved the arm

    run.at = {0.45: lambda: vars(bench.fake.faults).update(silent=True), 0.51: resume}
    assert run(1.5) is None
    assert "no feedback from the arm" in run.said[0]
    assert run.said[1:] == ["going on"]
    assert_braked(run)


@pytest.mark.parametrize(
    ("faults", "words"),
    [
        ({"status": 7}, "collision"),
        ({"zeros": True}, "only zeros"),
        ({"dead_driver": 1}, "driver is off"),
    ],
)
def test_an_arm_with_a_fault_holds_where_it_is(bench, faults, words):
    run, seen = Run(bench, Turning()), []

    def fail():
        vars(bench.fake.faults).update(faults)
        bench.fake._tick = -1  # the drivers' states, every tenth time, come next
        seen.append(bench.world.pose)

    run.at = {0.5: fail}
    assert words in run(5.0)
    if "zeros" not in faults:  # it does not push on against what stopped it
        assert run.path[-1, 0] == pytest.approx(seen[0][0], abs=0.012)
    assert_holds(run, words, jump=0.03)
    assert np.abs(run.path[-1] - bench.arms.rest)[:6].max() > 0.5


@pytest.mark.usefixtures("near_rest")
def test_a_collision_does_not_end_by_itself(bench):
    run = Run(bench, ask := Turning())
    run.at = {
        0.52: lambda: vars(bench.fake.faults).update(status=7),
        0.6: lambda: vars(bench.fake.faults).update(status=0),
    }
    assert "collision" in run(30.0)
    assert "going on" not in run.said
    assert len(ask.asked) == 2


def test_a_person_who_guides_the_arm_gets_it(bench):
    run = Run(bench, Turning())
    run.at = {0.5: lambda: bench.arm.teach(True)}
    assert "control mode 2 (teaching)" in run(5.0)
    sent = bench.fake.commands
    bench.wait(0.1)
    assert bench.fake.commands == sent < 120


@pytest.mark.usefixtures("near_rest")
def test_a_chunk_with_nan_is_refused_and_the_arm_goes_to_rest(bench):
    ask = Turning()
    run = Run(bench, ask)
    last = np.where(np.arange(10) < 9, 1.0, np.nan)[:, None]  # an action that is not executed
    run.at = {0.3: lambda: setattr(ask, "change", lambda actions: actions * last)}
    assert "actions must be finite" in run(30.0)
    np.testing.assert_allclose(bench.world.pose[:6], bench.arms.rest[:6], atol=0.03)
    assert run.said == [run.said[0], "moving slowly to the rest pose"]
    assert_holds(run, "actions must be finite")


def test_chunks_too_short_for_the_settings_are_an_error_before_the_arm_moves(bench, tmp_path):
    settings, start = {"execute": 5, "ahead": 3}, bench.world.pose
    sentence = "execute 5 and ahead 3 need chunks of at least 8 actions, got 7"
    with contextlib.closing(Log(tmp_path)) as log:
        run = Run(bench, Turning(7), settings=settings, log=log, latency=0.2)
        with pytest.raises(ValueError, match=f"^{sentence}$"):
            run(1.0)
    bench.wait(0.5)
    np.testing.assert_allclose(bench.world.pose, start, atol=2e-3)
    assert sentence in (tmp_path / "log.jsonl").read_text()
    assert_safe(run)


@pytest.mark.usefixtures("near_rest")
def test_a_later_chunk_that_is_too_short_is_refused_and_the_arm_goes_to_rest(bench):
    run = Run(bench, ask := Turning(8), settings={"execute": 5, "ahead": 3})
    run.at = {0.3: lambda: setattr(ask, "change", lambda actions: actions[:7])}
    assert "need chunks of at least 8 actions, got 7" in run(30.0)
    assert run.said[1:] == ["moving slowly to the rest pose"]
    assert_holds(run, "at least 8 actions")


@pytest.mark.usefixtures("near_rest")
def test_a_server_that_dies_in_mid_chunk(bench):
    policy = StandIn()
    policy.prepare = lambda adapter, request, index: request.state
    with contextlib.ExitStack() as stack:
        client = PolicyClient(stack.enter_context(serving(policy)).address)
        run = Run(bench, Server(client))
        run.at = {0.72: stack.close}
        problem = run(30.0)
    client.close()
    assert "closed the connection" in problem
    assert run.said[1:] == ["moving slowly to the rest pose"]
    assert_holds(run, "closed the connection")


@pytest.mark.usefixtures("near_rest")
def test_a_server_that_refuses(bench):
    with serving(StandIn()) as server:
        client = PolicyClient(server.address)
        ask = Server(client)
        run = Run(bench, lambda o: ask({**o, "prompt": 3}))
        assert "prompt must be text" in run(30.0)
    assert_holds(run, "prompt must be text")


@pytest.mark.usefixtures("near_rest")
@pytest.mark.parametrize(
    "error", mostly_slow([FrameError, TypeError, ConcurrencyError], [TypeError])
)
def test_a_policy_that_raises_anything(bench, error):
    run = Run(bench, ask := Turning())

    def change(actions):
        raise error("bad")

    run.at = {0.3: lambda: setattr(ask, "change", change)}
    assert run(30.0) == "bad"
    assert run.said[1:] == ["moving slowly to the rest pose"]
    assert_holds(run, "bad")


PLACES = ("look", "recorder", "log", "done")
TRACEBACK = "Traceback (most recent call last):\n  File \"x.py\"\nKeyError: 'state'"
CASES = [(place, error) for place in PLACES for error in (OSError, KeyboardInterrupt)]
FAST = [*CASES[::2], ("look", KeyboardInterrupt)]


@pytest.mark.parametrize("case", mostly_slow(CASES, FAST), ids=str)
def test_every_other_error_brakes_and_is_raised(bench, case):
    where, error = case
    broken = []

    def work(*_):
        if bench.clock.now() > due and not broken:
            broken.append(where)
            raise error("it broke")
        return where == "look" and bench.world.images()

    due = bench.clock.now() + 0.45  # at full speed
    part = {
        "look": work,
        "recorder": types.SimpleNamespace(step=work),
        "log": types.SimpleNamespace(observation=work, line=lambda *_, **__: work()),
    }
    run = Run(bench, Turning(), **{name: x for name, x in part.items() if name == where})
    with pytest.raises(error, match="it broke"):
        run(30.0, work if where == "done" else lambda: False)
    assert run.said == [f"holding: {describe_any(error('it broke'))}"]
    assert_braked(run)


@pytest.mark.parametrize("part", ["read", "line", "say"])
def test_a_part_that_stays_broken_does_not_stop_the_brake(bench, part, monkeypatch):
    """The bus, the disk or the screen fails in mid-motion, and all that comes after it, too."""
    due = bench.clock.now() + 0.45

    def work(*_, **__):
        if bench.clock.now() > due:
            raise OSError("it broke")
        return read()

    read = bench.arm.read
    log = types.SimpleNamespace(observation=lambda *_: None, line=lambda *_, **__: None)
    options = {"say": work} if part == "say" else {}
    run = Run(bench, ask := Turning(), log=log, **options)
    monkeypatch.setattr(
        *{"read": (bench.arm, "read"), "line": (log, "line")}.get(part, (run, "x")),
        work,
        raising=False,
    )
    if part == "say":
        run.at = {0.45: lambda: setattr(ask, "change", lambda actions: actions[:, :3])}
    with pytest.raises(OSError, match="it broke"):
        run(30.0)
    assert run.session.problem
    assert_braked(run)


def test_the_arm_stands_still_before_anything_is_said(bench):
    """A terminal may block, for example when its connection hangs."""
    speeds = []

    def say(_):
        speeds.append(run.session._arms.moving)

    run = Run(bench, ask := Turning(), say=say)
    run.at = {0.3: lambda: setattr(ask, "change", lambda actions: actions[:, :3])}
    assert "actions must be numbers" in run(1.5)
    assert len(speeds) == 2
    assert not any(speeds)
    assert_braked(run)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (np.rad2deg, "joint 2 are far beyond its limits, such as 87"),
        (lambda actions: actions + 0.9 * np.eye(7)[6], "the gripper are far beyond its limits"),
        (lambda actions: actions + 0.01 * np.eye(7)[6], None),
        (lambda actions: np.where(np.arange(10)[:, None] % 2, actions, 9.0), None),  # not all
    ],
)
def test_wholly_clamped_chunks_are_warned_of_once(bench, change, words):
    run = Run(bench, ask := Turning())
    ask.change = change
    run(1.2)
    warnings = [text for text in run.said if text.startswith("warning")]
    assert len(warnings) == (words is not None)
    assert not words or words in warnings[0]
    assert_safe(run)


@pytest.mark.parametrize("number", mostly_slow(SIGNALS, [signal.SIGHUP]))
def test_a_signal_brakes_also_if_the_terminal_has_gone(bench, number):
    def say(sentence):
        raise OSError(f"no terminal for {sentence!r}")

    before = {each: signal.getsignal(each) for each in SIGNALS}
    run = Run(bench, Turning(), say=say)
    run.at = {0.45: lambda: signal.raise_signal(number)}
    try:
        stop_on_signals(run.session)
        with pytest.raises(OSError, match="no terminal for 'stopped'"):
            run(30.0)
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
    assert_braked(run)


@pytest.mark.usefixtures("near_rest")
def test_a_servers_traceback_is_one_sentence(bench):
    def ask(observation):
        raise PolicyError(TRACEBACK)

    run = Run(bench, ask)
    assert run(30.0) == "KeyError: 'state'"
    assert_holds(run, "KeyError: 'state'")


@pytest.mark.parametrize("actions", [None, "x", {"x": 1}, [[1.0], [1.0, 2.0]], [], 5, {}])
def test_replies_of_any_type_hold(bench, actions):
    reply = {"actions": actions} if actions != {} else {}
    client = types.SimpleNamespace(metadata={}, infer=lambda _: reply)
    run = Run(bench, Server(client))
    problem = run(0.2)
    assert "actions" in problem
    assert_holds(run, problem)


def test_a_closed_stdout_does_not_stop_the_brake(bench):
    def say(sentence):
        raise BrokenPipeError(sentence)

    run = Run(bench, ask := Turning(), say=say)
    run.at = {0.3: lambda: setattr(ask, "change", lambda actions: actions[:, :3])}
    with pytest.raises(BrokenPipeError, match="actions must be numbers"):
        run(30.0)
    assert_braked(run)


@pytest.mark.parametrize("kinds", [frames.JOINTS[:1], frames.DRIVERS])
def test_a_kind_of_frame_that_stops(bench, kinds):
    run = Run(bench, Turning())
    run.at = {0.5: lambda: bench.lose(kinds)}
    problem = run(5.0)
    assert run.said == [f"holding: {problem}"]
    assert_braked(run)


@pytest.mark.usefixtures("near_rest")
def test_a_server_that_hangs(bench):
    run = Run(bench, Turning(), latency=9.0, settings={"patience": 0.4})
    assert "did not answer within 0.4 s" in run(30.0)
    assert_holds(run, "did not answer")


def test_pictures_that_stop(bench):
    looks = itertools.count(1)

    def blink():
        if 1 < next(looks) < 20:
            raise NoPicture("camera wrist shows nothing new")
        return bench.world.images()

    run = Run(bench, Turning(), look=blink)
    assert run(1.5) is None
    assert run.said[:2] == ["holding: camera wrist shows nothing new", "going on"]


@pytest.mark.parametrize("way", mostly_slow(["short", "long"], ["short"]))
def test_pictures_that_stop_for_good(bench, way, request):
    if way == "short":
        request.getfixturevalue("near_rest")

    def die():
        if bench.clock.now() > due:
            raise NoPicture("camera wrist shows nothing new")
        return bench.world.images()

    due = bench.clock.now() + 0.45
    run = Run(bench, Turning(), look=die)
    assert "nothing new" in run(30.0)
    assert run.said == [run.said[0], "moving slowly to the rest pose"]
    np.testing.assert_allclose(bench.world.pose[:6], bench.arms.rest[:6], atol=0.03)
    assert_braked(run)
    assert_holds(run, "camera wrist shows nothing new")
