"""Episodes of the real arm's command, with a fake arm on its bus, and the keys that judge them."""

import dataclasses
import os
import pty
import signal
import sys
import termios
import types
from unittest.mock import Mock

import numpy as np
import pytest

from lorasp_jax.data.opening import open_source
from lorasp_jax.extras.piper import __main__ as command
from lorasp_jax.extras.piper import options
from lorasp_jax.extras.piper.__main__ import HELD
from lorasp_jax.extras.piper.__main__ import main as real
from lorasp_jax.extras.piper.arm import PiperArm
from lorasp_jax.extras.piper.arms import SIDES
from lorasp_jax.extras.piper.fake.firmware import FakePiper
from lorasp_jax.extras.piper.fake.timing import RealTime
from lorasp_jax.extras.piper.keys import SIGNALS, Keyboard
from lorasp_jax.extras.piper.log import Log
from lorasp_jax.extras.piper.recording import Recording
from lorasp_jax.extras.piper.session import Session
from tests.extras.piper.benches import channel
from tests.extras.piper.piper_runs import Still
from tests.extras.serving.stand_in import SPEC, serving


class LinkedArm(PiperArm):
    """A real arm's driver on the bus of a fake arm that lives in a thread."""

    def __init__(self, can, *, bus, **options):
        name = channel()
        self.world.reset(0)
        self.fake = FakePiper(name, self.world)
        super().__init__(name, bus="virtual", **options)
        self.time = RealTime(self.fake)
        self.time.start(self)

    def close(self):
        self.time.stop()
        super().close()
        self.fake.close()


@pytest.fixture
def linked(monkeypatch, film, world, patient):
    monkeypatch.setattr(LinkedArm, "world", world, raising=False)
    monkeypatch.setattr("lorasp_jax.extras.piper.__main__.PiperArm", LinkedArm)
    monkeypatch.setattr("lorasp_jax.extras.piper.cameras.MAX_AGE", 60.0)
    return ["--camera", f"side={film}", "--camera", f"wrist={film}", "--task", "press"]


class Script(Keyboard):
    """Answers questions with the keys of a script."""

    def __init__(self, keys):
        self.script, self.questions = [*keys], []

    def __enter__(self):
        self.ended = False
        return self

    def __exit__(self, *_):
        pass

    def ask(self, question, keys, seconds=None):
        self.questions.append(question)
        while self.script:
            if (key := self.script.pop(0)) in keys:
                return key
        raise EOFError("nobody")


@pytest.fixture
def press_keys(monkeypatch):
    def script(during, after):
        keys = Script(after)
        monkeypatch.setattr(command, "Keyboard", lambda: keys)
        pending = [*during]
        keys.pressed = lambda seconds=0.0: pending.pop(0) if pending else ""
        return keys

    return script


def test_the_real_command_with_an_arm_on_the_bus(server, linked, tmp_path, press_keys, capsys):
    press_keys("", "s")
    words = ["--server", server.address, *linked, "--seconds", "1.5"]
    words += ["--log", str(tmp_path / "log"), "--record", str(tmp_path / "data")]
    assert real([*words, "--image-size", "16"]) == 0, capsys.readouterr()
    assert "1 episodes recorded" in capsys.readouterr().out
    assert open_source(tmp_path / "data").num_steps >= 5


def test_several_episodes_are_recorded_in_one_start_and_in_the_next(
    server, linked, tmp_path, press_keys, capsys
):
    """One fails, one is done again, and one succeeds, with prompts that take turns."""
    words = ["--server", server.address, *linked, "--seconds", "0.3", "--image-size", "16"]
    words += ["--record", str(tmp_path / "data"), "--episodes", "2"]
    words += ["--prompt", "press it", "--prompt", "tap it"]
    keys = press_keys("", "f\na\ns")
    assert real([*words, "--log", str(tmp_path / "log")]) == 0
    printed = capsys.readouterr().out
    assert printed.count("moving slowly to the start pose") == 2
    assert "1 of 2 succeeded" in printed
    assert sum("scene" in question for question in keys.questions) == 2
    press_keys("", "q")  # a person who ends the next session at once
    assert real([*words, "--log", str(tmp_path / "log2")]) == 0
    press_keys("", "s\nq")
    assert real([*words, "--log", str(tmp_path / "log3")]) == 0
    source = open_source(tmp_path / "data")
    episodes = [source.episode(i) for i in range(len(source))]
    said = [e.phrases[0] for e in episodes]
    assert said == ["press it", "tap it", "press it"]
    assert [int(e.success[0]) for e in episodes] == [0, 1, 1]
    assert source.metadata["attempted"] == 3


def test_a_person_takes_over_by_hand(server, linked, tmp_path, press_keys, monkeypatch, capsys):
    """What follows is marked, and ends the session: the arm obeys again after a reset."""

    taught = []

    def teach(arm, on):
        arm.fake.hand = arm.read().pose
        taught.append(arm)
        PiperArm.teach(arm, on)

    def pressed(seconds=0.0):
        if taught:  # the hand turns the base from step to step
            taught[0].fake.hand = taught[0].fake.hand + np.eye(7)[0] * 0.01
        return script(seconds)

    monkeypatch.setattr(LinkedArm, "teach", teach, raising=False)
    keys = press_keys([*400 * [""], "t", *8 * [""], "s"], "")
    script, keys.pressed = keys.pressed, pressed
    words = ["--server", server.address, *linked, "--seconds", "30", "--image-size", "16"]
    words += ["--record", str(tmp_path / "data"), "--log", str(tmp_path / "log")]
    assert real([*words, "--episodes", "3"]) == 0
    printed = capsys.readouterr().out
    assert "take over: guide the arm by hand" in printed
    assert "after a reset of the arm" in printed
    source = open_source(tmp_path / "data")
    assert len(source) == 1
    episode = source.episode(0)
    assert int(episode.success[0]) == 1
    flags = episode.corrected[0]
    assert 2 <= flags.sum() < len(flags)
    assert flags[-flags.sum() :].all()  # the person acts until the end


def test_a_signal_while_the_arm_brakes_ends_a_take_over(
    server, linked, tmp_path, press_keys, monkeypatch, capsys
):
    settle, taught = Session._settle, Mock()

    def interrupted(session):
        signal.raise_signal(signal.SIGINT)
        settle(session)

    monkeypatch.setattr(Session, "_settle", interrupted)
    monkeypatch.setattr(LinkedArm, "teach", taught)
    keys = press_keys([*400 * [""], "t"], "q")
    words = ["--server", server.address, *linked, "--seconds", "30", "--image-size", "16"]
    words += ["--record", str(tmp_path / "data"), "--log", str(tmp_path / "log")]
    assert real(words) == 0
    assert not taught.called
    assert "take over" not in capsys.readouterr().out
    assert keys.questions == [command.QUESTION]


def test_a_key_ends_an_episode(server, linked, tmp_path, press_keys, capsys):
    keys = press_keys(["f", "f", "", "", "x", "s"], "")
    words = ["--server", server.address, *linked, "--seconds", "60", "--episodes", "2"]
    assert real([*words, "--log", str(tmp_path / "log"), "--reset-time", "0"]) == 0
    assert keys.questions == ["put the scene back, then press Enter, or q to quit"]
    assert "1 of 1 succeeded" in capsys.readouterr().out


def test_a_dry_run_needs_no_bus(film, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "PiperArm", Mock(side_effect=AssertionError("a bus")))
    monkeypatch.setattr("lorasp_jax.extras.piper.cameras.MAX_AGE", 60.0)
    words = ["--camera", f"side={film}", "--camera", f"wrist={film}", "--task", "press"]
    with serving(Still()) as server:
        words += ["--server", server.address, "--seconds", "0.3", "--dry-run"]
        assert real([*words, "--log", str(tmp_path)]) == 0
    assert "would command" in capsys.readouterr().out


def test_two_arms_on_two_buses(table, film, tmp_path, monkeypatch, patient, press_keys, capsys):
    """A policy of 14 dimensions moves both, and its episode becomes a two-armed dataset."""
    names = {name: channel() for name in SIDES}
    table.reset(0)
    fakes = [FakePiper(names[name], table, limb) for name, limb in table.limbs.items()]
    time, drivers = RealTime(*fakes), []

    def open_arm(can, **options):
        drivers.append(PiperArm(names[can], **options | {"bus": "virtual"}))
        if drivers[1:]:
            time.start(*drivers)
        return drivers[-1]

    monkeypatch.setattr(command, "PiperArm", open_arm)
    monkeypatch.setattr("lorasp_jax.extras.piper.cameras.MAX_AGE", 60.0)
    press_keys("", "s")
    spec = dataclasses.replace(SPEC, cameras=("top",), state_dim=14)
    with serving(Still(spec, metadata={"robot": "bi_piper", "action_dim": 14})) as server:
        words = ["--server", server.address, "--camera", f"top={film}", "--task", "hand_over"]
        words += ["--can", "right=right", "left=left", "--seconds", "1.5", "--image-size", "16"]
        words += ["--log", str(tmp_path / "log"), "--record", str(tmp_path / "data")]
        assert real(words) == 0, capsys.readouterr()
    time.stop()
    for fake in fakes:
        fake.close()
    assert all(fake.commands > 100 and not fake.unsafe for fake in fakes)
    source = open_source(tmp_path / "data")
    assert source.episode(0).robot == "bi_piper"
    assert source.grippers["action"] == [6, 13]
    np.testing.assert_allclose(source.episode(0).state[0, -1, [0, 7]], 0.0, atol=0.01)


def test_a_dry_run_without_a_bus_has_as_many_arms_as_the_policy(
    film, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("lorasp_jax.extras.piper.cameras.MAX_AGE", 60.0)
    spec = dataclasses.replace(SPEC, cameras=("top",), state_dim=14)
    with serving(Still(spec, metadata={"robot": "bi_piper-x", "action_dim": 14})) as server:
        words = ["--server", server.address, "--camera", f"top={film}", "--prompt", "go"]
        words += ["--arm", "piper-x", "--seconds", "0.3", "--dry-run", "--log", str(tmp_path)]
        assert real(words) == 0
    assert "would command left arm: " in (printed := capsys.readouterr().out)
    assert "; right arm: " in printed


def test_the_camera_is_asked_for_size_rate_and_format(server, monkeypatch, capsys):
    opened = Mock(side_effect=OSError("no device"))
    monkeypatch.setattr("av.open", opened)
    words = ["--server", server.address, "--task", "press", "--camera-size", "320x240"]
    words += ["--camera-rate", "60", "--camera-format", "mjpeg"]
    assert real([*words, "--camera", "side=/dev/video0", "--camera", "wrist=/dev/video2"]) == 2
    assert "cannot open camera side" in capsys.readouterr().err
    expected = {"video_size": "320x240", "framerate": "60", "input_format": "mjpeg"}
    opened.assert_called_once_with("/dev/video0", format="v4l2", options=expected)


def test_patience_is_an_option(linked, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(Session, "_rest", lambda _: None)  # the way to it takes long
    policy = Still()
    policy.gate.clear()
    with serving(policy) as slow:
        words = ["--server", slow.address, *linked, "--patience", "0.2"]
        assert real([*words, "--log", str(tmp_path / "log")]) == HELD
        policy.gate.set()
    assert "did not answer within 0.2 s" in capsys.readouterr().out


def test_a_log_that_cannot_be_completed_hides_no_problem(linked, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(Session, "run", lambda *_: "no way")
    monkeypatch.setattr(Log, "close", Mock(side_effect=OSError("a recording is incomplete")))
    with serving(Still()) as server:
        words = ["--server", server.address, *linked, "--dry-run", "--log"]
        assert real([*words, str(tmp_path / "held")]) == HELD
        assert "error: a recording is incomplete" in capsys.readouterr().err
        monkeypatch.setattr(Session, "run", lambda *_: None)
        assert real([*words, str(tmp_path / "done")]) == 2
    assert "error: a recording is incomplete" in capsys.readouterr().err


def test_a_dry_run_of_the_real_command(linked, tmp_path, capsys):
    policy = Still(instructions=("pour it",))
    with serving(policy) as server:
        words = ["--server", server.address, *linked, "--seconds", "0.5", "--dry-run"]
        assert real([*words, "--log", str(tmp_path)]) == 0
    before, command, _ = capsys.readouterr().out.partition("would command")
    assert command
    assert before.count("the policy was not trained for 'press the red button', but for") == 1


def test_teaching_with_the_real_command(linked, tmp_path, monkeypatch, press_keys, capsys):
    keys = press_keys("", "q")
    monkeypatch.setattr("lorasp_jax.extras.piper.teaching._STILL", -1.0)
    words = [*linked, "--seconds", "0.6", "--record", str(tmp_path / "data"), "--image-size", "16"]
    assert real([*words, "--teach", "hand"]) == 0
    assert keys.questions == [command.QUESTION]
    assert real([*words, "--teach", "leader"]) == HELD
    assert "no leader sends targets" in capsys.readouterr().out


@pytest.fixture
def terminal(monkeypatch):
    """A terminal; what is written to it are keys."""
    outer, inner = pty.openpty()
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp())
    with os.fdopen(inner) as stdin, os.fdopen(outer, "wb", buffering=0) as typing:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield typing


def test_keys_come_without_enter_and_the_terminal_is_given_back(terminal):
    before = termios.tcgetattr(sys.stdin)
    with Keyboard() as keys:
        assert keys.pressed() == ""
        terminal.write(b"xs")
        assert keys.ask("?", "sf") == "s"
        assert keys.ask("?", "sf", 0.01) == ""
        assert not keys.ended
    assert termios.tcgetattr(sys.stdin) == before


def test_in_the_background_the_terminal_is_left_alone(terminal, monkeypatch):
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: -1)
    monkeypatch.setattr("tty.setcbreak", Mock(side_effect=AssertionError("suspended")))
    with Keyboard() as keys:
        assert keys.ended
        terminal.write(b"s")
        assert keys.pressed() == ""


def test_without_a_terminal_nobody_answers(monkeypatch):
    with open(os.devnull) as null:
        monkeypatch.setattr(sys, "stdin", null)
        with Keyboard() as keys, pytest.raises(EOFError):
            keys.ask("?", "s")
        assert keys.ended
        assert keys.pressed() == ""


@pytest.mark.parametrize("number", [None, *SIGNALS])
def test_an_episode_that_nobody_judges_is_not_lost(number, tmp_path, capsys, terminal):
    ways = {"task": "press", "instructions": (), "control_dt": 0.1, "image_size": 16}
    recorder = Recording(tmp_path / "data", prompt="press it", **ways)
    recorder.step({"side": np.zeros((16, 16, 3), np.uint8)}, np.ones(7), np.ones(7))
    handlers = {each: signal.getsignal(each) for each in SIGNALS}
    rig = command.Rig(None, None, None, recorder, None, Keyboard())

    def interrupt(*_):
        signal.raise_signal(number)

    try:
        options.stop_on_signals(types.SimpleNamespace(stop=lambda: None))
        with rig.keys:
            rig.keys.ended = number is None
            rig.keys.pressed = interrupt
            if number == signal.SIGINT:
                with pytest.raises(KeyboardInterrupt, match="not kept"):
                    command._keep(rig, "")
            else:
                assert command._keep(rig, "") == ""
                assert rig.keys.ended
    finally:
        for each, handler in handlers.items():
            signal.signal(each, handler)
    kept = number != signal.SIGINT
    assert recorder.num_episodes == kept
    assert ("the episode is kept: 1 episodes recorded" in capsys.readouterr().out) == kept
