"""The two commands: the fake arm's, and the real arm's as far as it goes without one."""

import dataclasses
import json
import signal
import types
from unittest.mock import Mock

import numpy as np
import pytest

from envs.rendering.video import write_video
from envs.tasks import press
from lorasp_jax.data.opening import open_source
from lorasp_jax.extras.piper import __main__ as command
from lorasp_jax.extras.piper import options, safety
from lorasp_jax.extras.piper.__main__ import HELD
from lorasp_jax.extras.piper.__main__ import main as real
from lorasp_jax.extras.piper.arm import PiperArm
from lorasp_jax.extras.piper.fake import __main__ as faking
from lorasp_jax.extras.piper.fake.__main__ import main as fake
from lorasp_jax.extras.piper.fake.firmware import FakePiper
from lorasp_jax.extras.piper.fake.timing import RealTime
from lorasp_jax.extras.piper.recording import Recording
from lorasp_jax.extras.serving.client import PolicyClient
from tests.cases import mostly_slow
from tests.extras.piper.benches import channel
from tests.extras.serving.stand_in import SPEC, StandIn, serving


class Still(StandIn):
    """Answers with the state, so that the arm does not move."""

    def prepare(self, adapter, request, index):
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
    monkeypatch.setattr(options, "_WAIT", 0.0)
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

    def prepare(self, adapter, request, index):
        if index[1] == self.last:
            raise ValueError("the policy has left")
        return super().prepare(adapter, request, index)


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


@pytest.mark.parametrize("adapter", ["", "pour", "press"])
def test_an_adapter_of_another_task_is_warned_of(adapter, capsys):
    policy = Still(adapters=("pour", "press"))
    policy.instructions = {"pour": ("pour it", "tip it"), "press": ("press it",)}
    with serving(policy) as server, PolicyClient(server.address) as client:
        options.Server(client, adapter).warn(["tip it", "press it"])
    new, known = ("tip it", "press it") if adapter == "press" else ("press it", "pour it")
    assert f"not trained for {new!r}, but for requests such as {known!r}" in capsys.readouterr().out


def test_an_adapter_of_the_server_can_be_chosen():
    policy = Still(adapters=("a", "b"))
    state, picture = np.zeros(7, np.float32), np.zeros((48, 64, 3), np.uint8)
    question = {"image": {"side": picture, "wrist": picture}, "state": state, "prompt": "go"}
    with serving(policy) as server, PolicyClient(server.address) as client:
        options.Server(client)(question)
        options.Server(client, "b")(question)
        with pytest.raises(ValueError, match="the server has no adapter 'c', but a, b"):
            options.Server(client, "c")
    assert [name for name, _ in policy.batches] == ["a", "b"]


@pytest.mark.parametrize("execution", ["naive", "guided"])
def test_only_servers_that_continue_chunks_are_told_how_far_the_arm_is(execution):
    policy = Still(dataclasses.replace(SPEC, execution=execution))
    with serving(policy) as server, PolicyClient(server.address) as client:
        ask = options.Server(client)
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
    monkeypatch.setattr(options, "_WAIT", 0.0)
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


def test_the_real_command_with_an_arm_on_the_bus(server, linked, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("builtins.input", lambda question: "y")
    words = ["--server", server.address, *linked, "--seconds", "1.5"]
    words += ["--log", str(tmp_path / "log"), "--record", str(tmp_path / "data")]
    assert real([*words, "--image-size", "16"]) == 0, capsys.readouterr()
    assert "1 episodes recorded" in capsys.readouterr().out
    assert open_source(tmp_path / "data").num_steps >= 5


def test_a_dry_run_of_the_real_command(linked, tmp_path, capsys):
    policy = Still(instructions=("pour it",))
    with serving(policy) as server:
        words = ["--server", server.address, *linked, "--seconds", "0.5", "--dry-run"]
        assert real([*words, "--log", str(tmp_path)]) == 0
    before, command, _ = capsys.readouterr().out.partition("would command")
    assert command
    assert before.count("the policy was not trained for 'press the red button', but for") == 1


def test_teaching_with_the_real_command(linked, tmp_path, monkeypatch, capsys):
    questions = []
    monkeypatch.setattr("builtins.input", lambda question: questions.append(question) or "n")
    monkeypatch.setattr("lorasp_jax.extras.piper.teaching._STILL", -1.0)
    words = [*linked, "--seconds", "0.6", "--record", str(tmp_path / "data"), "--image-size", "16"]
    assert real([*words, "--teach", "hand"]) == 0
    assert questions[0].startswith("keep this episode of ")
    assert real([*words, "--teach", "leader"]) == HELD
    assert "no leader sends targets" in capsys.readouterr().out


@pytest.mark.parametrize("number", [None, *options.SIGNALS])
def test_an_episode_that_nobody_judges_is_not_lost(number, tmp_path, monkeypatch, capsys):
    def ask(question):
        if number:
            signal.raise_signal(number)
        raise EOFError("EOF when reading a line")

    monkeypatch.setattr("builtins.input", ask)
    ways = {"task": "press", "instructions": (), "control_dt": 0.1, "image_size": 16}
    recorder = Recording(tmp_path / "data", prompt="press it", **ways)
    recorder.step({"side": np.zeros((16, 16, 3), np.uint8)}, np.ones(7), np.ones(7))
    handlers = {each: signal.getsignal(each) for each in options.SIGNALS}
    try:
        options.stop_on_signals(types.SimpleNamespace(stop=lambda: None))
        if number == signal.SIGINT:
            with pytest.raises(KeyboardInterrupt, match="not kept"):
                command._keep(recorder)
        else:
            command._keep(recorder)
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
