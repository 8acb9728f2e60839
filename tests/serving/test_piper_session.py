"""The control loop on the fake arm, through the unmodified piper_sdk: execution and faults."""

import contextlib
import json
import types

import numpy as np
import pytest
from PIL import Image

from lorasp_jax.serving.client import PolicyClient, ServerGone
from lorasp_jax.serving.fake_piper.demonstrator import Demonstrator
from lorasp_jax.serving.piper import session as sessions
from lorasp_jax.serving.piper.asking import InThread, InTurn
from lorasp_jax.serving.piper.cameras import NoPicture, Simulated
from lorasp_jax.serving.piper.log import Log
from lorasp_jax.serving.piper.options import Server
from lorasp_jax.serving.piper.safety import Limits
from lorasp_jax.serving.piper.session import PERIOD, Session, Settings
from tests.serving.benches import Bench
from tests.serving.stand_in import StandIn, serving

LIMITS = Limits.of()
ARM_STEP = np.array([0.03, 0, 0, 0, 0, 0, 0])  # rad per action


class Turning:
    """Turns the base by `ARM_STEP` an action; keeps what it was asked."""

    def __init__(self, chunk=10):
        self.asked, self.chunk, self.change = [], chunk, lambda actions: actions

    def __call__(self, observation):
        self.asked.append(observation)
        steps = np.arange(1, self.chunk + 1)[:, None]
        return self.change(observation["state"] + steps * ARM_STEP)


class Run:
    """A session whose sentences are kept; `at` calls functions at times since the start."""

    def __init__(self, bench, ask, *, cameras=None, latency=0.0, **options):
        self.bench, self.said, self.at, self.commands = bench, [], {}, []
        settings = Settings("turn", hold=options.pop("hold", 0.5), **options.pop("settings", {}))
        asker = options.pop("asker", None) or InTurn(ask, bench.clock, latency)
        cameras = cameras or Simulated(bench.world.images)
        self.session = Session(
            bench.arm,
            cameras,
            asker,
            LIMITS,
            settings,
            bench.clock,
            say=self.said.append,
            **options,
        )

    def __call__(self, seconds, done=lambda: False):
        start, pending = self.bench.clock.now(), dict(self.at)

        def each_tick():
            self.commands.append(self.session._governor.pose.copy())
            for time in [t for t in pending if self.bench.clock.now() - start >= t]:
                pending.pop(time)()
            return done()

        return self.session.run(seconds, each_tick)

    @property
    def path(self):
        return np.stack(self.commands)


def assert_safe(run, jump=0.0):
    """Check the commands of all ticks, and what the fake arm thinks of them.

    At the start of a hold, the command may jump back to the measured pose [rad].
    """
    steps = np.abs(np.diff(run.path, axis=0)[:, :6]).max(axis=1)
    assert np.sort(steps)[-2] < 1.0 * PERIOD + 1e-9
    assert steps.max() < max(jump, 1.0 * PERIOD + 1e-9)
    assert run.bench.fake.unsafe == []


def assert_holds(run, words, jump=0.0):
    """Check that the arm stands still, and that one sentence says why."""
    bench = run.bench
    bench.wait(0.5)  # until the servos have caught up
    before = bench.world.pose
    bench.wait(0.3)
    np.testing.assert_allclose(bench.world.pose, before, atol=2e-3)
    holding = [text for text in run.said if text.startswith("holding")]
    assert len(holding) == 1, run.said
    assert words in holding[0]
    assert_safe(run, jump)


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
    ("latency", "delay", "wait"), [(0.0, 0, 0), (0.2, 2, 0), (0.16, 2, 0), (0.5, 3, 2)]
)
def test_a_new_chunk_takes_over_as_in_the_simulation(bench, latency, delay, wait):
    """It starts where the previous one was, at the end of an action, even if they disagree."""
    chunks, targets, recorded = [], [], []
    base = bench.arm.read().pose[0]

    def ask(observation):
        chunk = np.tile(observation["state"], (8, 1))
        chunk[:, 0] = base + 0.001 * (len(chunks) + 0.1) * np.arange(1, 9)
        chunks.append(chunk[:, 0])
        return chunk

    recorder = types.SimpleNamespace(step=lambda images, state, action: recorded.append(action[0]))
    run = Run(bench, ask, latency=latency, settings={"ahead": 3}, recorder=recorder)
    step = run.session._governor.step
    run.session._governor.step = lambda target: targets.append(target[0]) or step(target)
    run(latency + 1.5)
    parts = [chunks[0][: 5 + delay], *(chunk[delay : 5 + delay] for chunk in chunks[1:])]
    waits = [np.repeat(part[-1], wait) for part in parts]
    actions = np.concatenate([x for both in zip(parts, waits, strict=True) for x in both])
    first, last = 0.1, 1.4  # s; the way to the first action depends on where the arm was
    times = np.arange(first, last, PERIOD)
    expected = np.interp(times, 0.1 * np.arange(1, 1 + len(actions)), actions)
    np.testing.assert_allclose(targets[round(first / PERIOD) :][: len(times)], expected, atol=1e-6)
    np.testing.assert_array_equal(recorded, np.concatenate(parts)[: len(recorded)])


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


def test_going_on_starts_from_the_measured_pose(bench):
    run, pushed = Run(bench, Turning(), hold=5.0), []

    def push():
        bench.fake.faults.silent = False
        bench.world.data.qpos[0] += 0.3  # meanwhile somebody has moved the arm
        pushed.append(bench.world.pose[0])

    run.at = {0.5: lambda: vars(bench.fake.faults).update(silent=True), 0.7: push}
    run(0.9)
    jump = np.abs(np.diff(run.path[:, 0])).argmax() + 1
    assert run.path[jump, 0] == pytest.approx(pushed[0], abs=0.05)


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
        seen.append(bench.world.pose)

    run.at = {0.5: fail}
    assert words in run(5.0)
    if "zeros" not in faults:  # it does not push on against what stopped it
        assert run.path[-1, 0] == pytest.approx(seen[0][0], abs=0.012)
    assert_holds(run, words, jump=0.03)
    assert np.abs(run.path[-1] - sessions.REST)[:6].max() > 0.5


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


def test_a_chunk_with_nan_is_refused_and_the_arm_goes_to_rest(bench):
    ask = Turning()
    run = Run(bench, ask)
    last = np.where(np.arange(10) < 9, 1.0, np.nan)[:, None]  # an action that is not executed
    run.at = {0.3: lambda: setattr(ask, "change", lambda actions: actions * last)}
    assert "actions must be finite" in run(30.0)
    np.testing.assert_allclose(bench.world.pose[:6], sessions.REST[:6], atol=0.03)
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


def test_a_later_chunk_that_is_too_short_is_refused_and_the_arm_goes_to_rest(bench):
    run = Run(bench, ask := Turning(8), settings={"execute": 5, "ahead": 3})
    run.at = {0.3: lambda: setattr(ask, "change", lambda actions: actions[:7])}
    assert "need chunks of at least 8 actions, got 7" in run(30.0)
    assert run.said[1:] == ["moving slowly to the rest pose"]
    assert_holds(run, "at least 8 actions")


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


def test_a_first_target_out_of_reach(bench, monkeypatch):
    monkeypatch.setattr(sessions, "_APPROACH_TIME", 3.0)
    ask = Turning()
    ask.change = lambda actions: actions + np.array([0, 1.0, 0, 0, 0, 0, 0])  # below the table
    run = Run(bench, ask)
    assert "the first action is out of reach" in run(60.0)
    assert_safe(run)


def test_a_server_that_dies_in_mid_chunk(bench):
    policy = StandIn()
    policy.prepare = lambda request, index: request.state
    with contextlib.ExitStack() as stack:
        client = PolicyClient(stack.enter_context(serving(policy)).address)
        run = Run(bench, Server(client))
        run.at = {0.72: stack.close}
        problem = run(30.0)
    client.close()
    assert "closed the connection" in problem
    assert run.said[1:] == ["moving slowly to the rest pose"]
    assert_holds(run, "closed the connection")


def test_a_server_that_refuses(bench):
    with serving(StandIn()) as server:
        client = PolicyClient(server.address)
        ask = Server(client)
        run = Run(bench, lambda o: ask({**o, "prompt": 3}))
        assert "prompt must be text" in run(30.0)
    assert_holds(run, "prompt must be text")


def test_a_server_that_hangs(bench):
    run = Run(bench, Turning(), latency=9.0, settings={"patience": 0.4})
    assert "did not answer within 0.4 s" in run(30.0)
    assert_holds(run, "did not answer")


def test_clock_steps_change_nothing(bench):
    run = Run(bench, ask := Turning())
    run.at = {
        0.3: lambda: vars(bench.fake.faults).update(clock_step=-3600.0),
        0.6: lambda: vars(bench.fake.faults).update(clock_step=3600.0),
    }
    assert run(1.0) is None
    assert run.said == []
    assert len(ask.asked) == 2


def test_pictures_that_stop(bench):
    class Blinking(Simulated):
        seen = 0

        def read(self):
            self.seen += 1
            if 1 < self.seen < 20:
                raise NoPicture("camera wrist shows nothing new")
            return super().read()

    run = Run(bench, Turning(), cameras=Blinking(bench.world.images))
    assert run(1.5) is None
    assert run.said[:2] == ["holding: camera wrist shows nothing new", "going on"]


def test_stop_brakes_and_holds_without_resting(bench):
    run = Run(bench, Turning())
    run.at = {0.5: run.session.stop}
    start = bench.world.pose
    assert run(30.0) is None
    assert bench.clock.now() < 3.0
    bench.wait(0.5)
    moved = bench.world.pose - start
    assert 0.1 < moved[0] < 0.25
    assert bench.fake.unsafe == []


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


def test_wrong_settings_are_refused():
    with pytest.raises(ValueError, match="ahead must be 0 to 4, got 5"):
        Settings("turn", ahead=5)


def test_asking_in_a_thread(bench):
    asker = InThread(Turning())
    asker.ask({"state": np.zeros(7)})
    asker._thread.join()
    assert asker.answer().shape == (10, 7)

    def gone(_):
        raise ServerGone("gone")

    asker = InThread(gone)
    asker.ask({})
    asker._thread.join()
    with pytest.raises(ServerGone, match="gone"):
        asker.answer()


def test_the_expert_presses_the_button_through_the_whole_chain(bench):
    expert = Demonstrator(bench.world, bench.clock, seed=0)
    run = Run(bench, expert)
    done = bench.every_control_step(bench.world.judge)
    assert run(8.0, done) is None
    assert bench.world.success
    assert_safe(run)
