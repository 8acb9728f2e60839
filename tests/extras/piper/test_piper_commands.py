"""The two commands: the fake arm's, and the real arm's as far as it goes without one."""

import dataclasses
import json
import os
import pty
import signal
import sys
import termios
import types
from unittest.mock import Mock

import av
import numpy as np
import pytest

from envs.rendering.video import write_video
from envs.tasks import press
from lorasp_jax.data.opening import open_source
from lorasp_jax.extras.piper import __main__ as command
from lorasp_jax.extras.piper import options, remote, safety
from lorasp_jax.extras.piper.__main__ import HELD
from lorasp_jax.extras.piper.__main__ import main as real
from lorasp_jax.extras.piper.arm import PiperArm
from lorasp_jax.extras.piper.fake import __main__ as faking
from lorasp_jax.extras.piper.fake.__main__ import main as fake
from lorasp_jax.extras.piper.fake.firmware import FakePiper
from lorasp_jax.extras.piper.fake.timing import RealTime
from lorasp_jax.extras.piper.keys import SIGNALS, Keys
from lorasp_jax.extras.piper.recording import Recording
from lorasp_jax.extras.piper.session import Session
from lorasp_jax.extras.serving.client import PolicyClient
from tests.cases import mostly_slow
from tests.extras.piper.benches import channel
from tests.extras.serving.stand_in import SPEC, StandIn, serving


class Still(StandIn):
    """Answers with the state, so that the arm does not move."""

    def prepare(self, request, index):
        self.last_request = request
        return request.state


@pytest.fixture(autouse=True)
def shared_world(world, monkeypatch):
    """Let all commands use one scene, as each compiles its own."""
    make = Mock(return_value=world)
    monkeypatch.setattr(faking, "World", make)
    return make


@pytest.fixture
def patient(monkeypatch):
    """Tolerate that a busy machine pauses the arm's thread."""
    monkeypatch.setattr(safety, "MAX_AGE", 60.0)
    monkeypatch.setattr(safety, "MAX_DRIVER_AGE", 60.0)


@pytest.fixture
def limit(monkeypatch):
    """Return a function that sets the task's time limit [s]."""
    return lambda seconds: monkeypatch.setattr(
        press, "TASK", dataclasses.replace(press.TASK, time_limit=seconds)
    )


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setattr(remote, "_WAIT", 0.0)
    policy = Still()
    with serving(policy) as server:
        server.policy = policy
        yield server


@pytest.fixture
def film(tmp_path):
    write_video(tmp_path / "film.mp4", np.zeros((5, 32, 32, 3), np.uint8), 30)
    return str(tmp_path / "film.mp4")


@pytest.mark.parametrize("seconds", mostly_slow([0.4, 8.0], [0.4]))
def test_the_expert_on_the_fake_arm(tmp_path, capsys, limit, seconds):
    limit(seconds)
    won = seconds > 1
    film = tmp_path / "film.mp4"
    words = ["--expert", "--task", "press", "--episodes", "1", "--seed", "2"]
    words += ["--image-size", "16", "--log", str(tmp_path / "log"), "--video", str(film)]
    assert fake([*words, "--record", str(tmp_path / "data")]) == 0
    printed = capsys.readouterr().out
    assert f"episode 0: {'success' if won else 'failure'}" in printed
    assert f"{won:d} of 1 succeeded" in printed
    assert film.stat().st_size > 1000
    with av.open(str(film)) as container:
        *_, last = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert last.shape == (256, 512, 3)
    edge = last[2:10, 100:400].mean((0, 1))  # green after success, else red
    assert edge.argmax() == int(won)
    assert edge.max() > 100 > 60 > edge[1 - won]
    lines = (tmp_path / "log" / "log.jsonl").read_text().splitlines()
    assert json.loads(lines[0])["episode"] == 0
    if won:
        source = open_source(tmp_path / "data")
        assert source.episode(0).image["side"].shape[2:] == (16, 16, 3)
        assert 25 < source.num_steps < 50


def test_the_command_line_chooses_task_and_image_size(shared_world, tmp_path):
    shared_world.side_effect = ValueError("this test needs no scene")
    words = ["--expert", "--task", "pour", "--image-size", "32", "--log", str(tmp_path)]
    assert fake(words) == 2
    shared_world.assert_called_once_with("pour", image_size=32)


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("more", mostly_slow([[], ["--realtime"]], [[]]))
def test_a_served_policy_on_the_fake_arm(server, tmp_path, capsys, limit, more):
    limit(1.0)
    words = ["--server", server.address, "--log", str(tmp_path / "log"), *more]
    assert fake([*words, "--latency", "0.1", "--thinking", "0.1"]) == 0
    assert "episode 0: failure\n" in capsys.readouterr().out
    assert server.policy.last_request.images["wrist"].shape == (16, 16, 3)
    assert server.policy.last_request.prompt


@pytest.mark.usefixtures("patient")
def test_an_episode_may_end_with_an_open_question(tmp_path, capsys, limit):
    limit(0.2)
    with serving(Still(seconds=0.5)) as server:
        words = ["--server", server.address, "--log", str(tmp_path), "--realtime"]
        assert fake([*words, "--episodes", "2"]) == 0
    assert "0 of 2 succeeded" in capsys.readouterr().out


class Leaving(Still):
    """Refuses the request number `last`, from 0, after which the server closes the connection."""

    def prepare(self, request, index):
        if index[1] == self.last:
            raise ValueError("the policy has left")
        return super().prepare(request, index)


@pytest.mark.parametrize(
    ("last", "before"), [(1, "no episode was judged"), (4, "before, 0 of 2 succeeded (0% to 66%)")]
)
def test_a_server_that_leaves_ends_the_run(last, before, tmp_path, limit, capsys):
    """An episode of 0.7 s asks twice."""
    limit(0.7)
    policy = Leaving()
    policy.last = last
    words = ["--log", str(tmp_path / "log"), "--video", str(tmp_path / "film.mp4")]
    with serving(policy) as server:
        assert fake(["--server", server.address, "--episodes", "8", *words]) == 2
    printed = capsys.readouterr()
    episode = last // 2
    assert f"stopped in episode {episode}, as the policy has left; {before}" in printed.err
    assert printed.out.count(": failure") == episode
    assert "succeeded" not in printed.out
    assert (tmp_path / "film.mp4").stat().st_size > 1000


@pytest.mark.parametrize(
    ("known", "warned"),
    [(press.TASK.instructions, False), (("pour it", "tip it"), True), ((), False)],
)
def test_a_policy_of_another_task_is_warned_of(known, warned, limit, tmp_path, capsys):
    limit(0.1)
    with serving(Still(instructions=known)) as server:
        assert fake(["--server", server.address, "--log", str(tmp_path / "log")]) == 0
    before = capsys.readouterr().out.partition("episode 0")[0]
    expected = f"warning: the policy was not trained for {press.TASK.instructions[0]!r}, "
    assert (expected in before) == ("warning" in before) == warned


@pytest.mark.parametrize(
    ("metadata", "words", "code", "message"),
    [
        ({"robot": "so100"}, [], 2, "of the robot so100, not of piper: pass --robot so100"),
        ({"robot": "so100"}, ["--robot", "so100"], 0, ""),
        ({"action_dim": 8}, [], 2, "have 8 numbers, but a PiPER takes 7"),
        ({"control_dt": 0.05}, [], 0, ""),
        ({"control_dt": 0.05}, ["--control-dt", "0.1"], 0, "acts every 0.05 s, not every 0.1 s"),
        ({"cameras": 5}, [], 2, "are malformed: cameras must be a list"),
    ],
)
def test_the_policys_robot_and_period_are_kept(
    metadata, words, code, message, tmp_path, limit, capsys
):
    limit(0.15)
    policy = Still(metadata=metadata)
    with serving(policy) as server:
        words = ["--server", server.address, "--log", str(tmp_path), "--execute", "2", *words]
        assert fake(words) == code
    printed = capsys.readouterr()
    assert message in " ".join((printed.out + printed.err).split())
    assert ("warning" in printed.out) == (code == 0 and bool(message))
    told = {"control_dt": 0.05}.items() <= metadata.items() and not message
    assert len(policy.batches) == (0 if code else 2 if told else 1)


@pytest.mark.parametrize("adapter", ["", "pour", "press"])
def test_an_adapter_of_another_task_is_warned_of(adapter, capsys):
    policy = Still(adapters=("pour", "press"))
    policy.instructions = {"pour": ("pour it", "tip it"), "press": ("press it",)}
    with serving(policy) as server, PolicyClient(server.address) as client:
        remote.Server(client, adapter).warn(["tip it", "press it"])
    new, known = ("tip it", "press it") if adapter == "press" else ("press it", "pour it")
    assert f"not trained for {new!r}, but for requests such as {known!r}" in capsys.readouterr().out


def test_an_adapter_of_the_server_can_be_chosen():
    policy = Still(adapters=("a", "b"))
    state, picture = np.zeros(7, np.float32), np.zeros((48, 64, 3), np.uint8)
    question = {"image": {"side": picture, "wrist": picture}, "state": state, "prompt": "go"}
    with serving(policy) as server, PolicyClient(server.address) as client:
        remote.Server(client)(question)
        remote.Server(client, "b")(question)
        with pytest.raises(ValueError, match="the server has no adapter 'c', but a, b"):
            remote.Server(client, "c")
    assert [name for name, _ in policy.batches] == ["a", "b"]


@pytest.mark.parametrize("execution", ["naive", "guided"])
def test_only_servers_that_continue_chunks_are_told_how_far_the_arm_is(execution):
    policy = Still(dataclasses.replace(SPEC, execution=execution))
    with serving(policy) as server, PolicyClient(server.address) as client:
        ask = remote.Server(client)
        state, large = np.zeros(7, np.float32), np.zeros((48, 64, 3), np.uint8)
        question = {"image": {"side": large, "wrist": large}, "state": state, "prompt": "go"}
        assert ask(question).shape == (10, 7)
        assert ask(question | {"executed": 5, "delay": 3}).shape == (10, 7)
    told = policy.last_request.executed, policy.last_request.delay
    assert told == ((None, 0) if execution == "naive" else (5, 3))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--task", "juggle"], "unknown task 'juggle'"),
        (["--latency", "0.2"], "--latency must be 0 to 0.15 s"),
        (["--thinking", "-1"], "--thinking must be at least 0 s, got -1.0"),
        (["--speed", "9"], "at most 3 rad/s, got 9.0"),
        (["--ahead", "5"], "ahead must be 0 to 4"),
    ],
)
def test_the_fake_arm_refuses_wrong_options(words, message, tmp_path, capsys):
    assert fake(["--expert", "--log", str(tmp_path), *words]) == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_no_server(monkeypatch, capsys):
    monkeypatch.setattr(remote, "_WAIT", 0.0)
    assert fake(["--server", "ws://127.0.0.1:9"]) == 2
    assert "no policy server at ws://127.0.0.1:9" in capsys.readouterr().err


def test_the_real_arm_needs_a_task_cameras_and_a_bus(server, film, capsys):
    words = ["--server", server.address]
    assert real(words) == 2
    assert "pass --task or --prompt" in capsys.readouterr().err
    words += ["--task", "press"]
    assert real(words) == 2
    expected = "for side, wrist: pass --camera side=SOURCE --camera wrist=SOURCE, such as"
    assert expected in capsys.readouterr().err
    assert real([*words, "--camera", f"side={film}"]) == 2
    assert "for side, wrist: pass --camera wrist=SOURCE, such as" in capsys.readouterr().err
    words += ["--camera", f"side={film}", "--camera", "wrist=/dev/video_nowhere"]
    assert real(words) == 2
    assert "cannot open camera wrist" in capsys.readouterr().err
    words[-1] = f"wrist={film}"
    assert real([*words, "--can", "can_nowhere"]) == 2
    assert "cannot open can_nowhere" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        real([*words, "--camera", "side"])
    assert "--camera: must be NAME=VALUE, got 'side'" in capsys.readouterr().err


def test_the_real_arm_is_not_on_a_virtual_bus(capsys):
    with pytest.raises(SystemExit):
        real(["--task", "press", "--bus", "virtual"])
    assert "--bus: invalid choice: 'virtual'" in capsys.readouterr().err


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


class Script(Keys):
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
        monkeypatch.setattr(command, "Keys", lambda: keys)
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
    """One fails, one is done again, and two succeed, with prompts that take turns."""
    words = ["--server", server.address, *linked, "--seconds", "0.3", "--image-size", "16"]
    words += ["--record", str(tmp_path / "data"), "--episodes", "2"]
    words += ["--prompt", "press it", "--prompt", "tap it"]
    keys = press_keys("", "f\na\ns\ns")
    assert real([*words, "--log", str(tmp_path / "log")]) == 0
    printed = capsys.readouterr().out
    assert printed.count("moving slowly to the start pose") == 3
    assert "2 of 3 succeeded" in printed
    assert sum("scene" in question for question in keys.questions) == 3
    press_keys("", "q")  # a person who ends the next session at once
    assert real([*words, "--log", str(tmp_path / "log2")]) == 0
    press_keys("", "s\nf\nq")
    assert real([*words, "--log", str(tmp_path / "log3")]) == 0
    source = open_source(tmp_path / "data")
    episodes = [source.episode(i) for i in range(len(source))]
    said = [e.instructions[int(e.instruction[0])] for e in episodes]
    assert said == ["press it", "tap it", "press it"]
    assert source.metadata["attempted"] == 4


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
    with Keys() as keys:
        assert keys.pressed() == ""
        terminal.write(b"xs")
        assert keys.ask("?", "sf") == "s"
        assert keys.ask("?", "sf", 0.01) == ""
        assert not keys.ended
    assert termios.tcgetattr(sys.stdin) == before


def test_in_the_background_the_terminal_is_left_alone(terminal, monkeypatch):
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: -1)
    monkeypatch.setattr("tty.setcbreak", Mock(side_effect=AssertionError("suspended")))
    with Keys() as keys:
        assert keys.ended
        terminal.write(b"s")
        assert keys.pressed() == ""


def test_without_a_terminal_nobody_answers(monkeypatch):
    with open(os.devnull) as null:
        monkeypatch.setattr(sys, "stdin", null)
        with Keys() as keys, pytest.raises(EOFError):
            keys.ask("?", "s")
        assert keys.ended
        assert keys.pressed() == ""


@pytest.mark.parametrize("number", [None, *SIGNALS])
def test_an_episode_that_nobody_judges_is_not_lost(number, tmp_path, capsys, terminal):
    ways = {"task": "press", "instructions": (), "control_dt": 0.1, "image_size": 16}
    recorder = Recording(tmp_path / "data", prompt="press it", **ways)
    recorder.step({"side": np.zeros((16, 16, 3), np.uint8)}, np.ones(7), np.ones(7))
    handlers = {each: signal.getsignal(each) for each in SIGNALS}
    rig = command.Rig(None, None, None, recorder, None, Keys())

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
                assert command._keep(rig, "") == "s"
                assert rig.keys.ended
    finally:
        for each, handler in handlers.items():
            signal.signal(each, handler)
    kept = number != signal.SIGINT
    assert recorder.num_episodes == kept
    assert ("the episode is kept: 1 episodes recorded" in capsys.readouterr().out) == kept


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--teach", "hand"], "--teach needs --record FOLDER"),
        (["--record", "data", "--dry-run"], "nothing to record"),
    ],
)
def test_options_that_do_not_go_together(words, message, capsys):
    assert real(["--task", "press", *words]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
