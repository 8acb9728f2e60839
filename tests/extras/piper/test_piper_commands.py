"""The two commands: the fake arm's, and the real arm's as far as it goes without one."""

import dataclasses
import json
from unittest.mock import Mock, patch

import av
import numpy as np
import pytest

from envs.tasks import press
from lorasp_jax.data.opening import open_source
from lorasp_jax.extras.piper import remote
from lorasp_jax.extras.piper.__main__ import main as real
from lorasp_jax.extras.piper.fake import __main__ as faking
from lorasp_jax.extras.piper.fake.__main__ import main as fake
from lorasp_jax.extras.piper.session import Session
from lorasp_jax.extras.serving import jpeg
from lorasp_jax.extras.serving.client import PolicyClient
from tests.cases import mostly_slow
from tests.extras.piper.piper_runs import Still
from tests.extras.serving.stand_in import SPEC, serving


@pytest.fixture(autouse=True)
def shared_world(world, monkeypatch):
    """Let all commands use one scene, as each compiles its own."""
    make = Mock(return_value=world)
    monkeypatch.setattr(faking, "World", make)
    return make


@pytest.fixture
def limit(monkeypatch):
    """Return a function that sets the task's time limit [s]."""
    return lambda seconds: monkeypatch.setattr(
        press, "TASK", dataclasses.replace(press.TASK, time_limit=seconds)
    )


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
@pytest.mark.parametrize(
    "more", mostly_slow([["--jpeg", "90"], [], ["--realtime"]], [["--jpeg", "90"]])
)
def test_a_served_policy_on_the_fake_arm(server, tmp_path, capsys, limit, more):
    limit(1.0)
    words = ["--server", server.address, "--log", str(tmp_path / "log"), *more]
    with patch.object(jpeg, "decode", wraps=jpeg.decode) as decode:
        assert fake([*words, "--latency", "0.1", "--thinking", "0.1"]) == 0
    assert decode.called == ("--jpeg" in more)
    assert "episode 0: failure\n" in capsys.readouterr().out
    assert server.policy.last_request.images["wrist"].shape == (16, 16, 3)
    assert server.policy.last_request.prompt


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize(("problem", "outcome"), [(None, 0), ("the server did not answer", -1)])
def test_a_problem_is_no_failure_of_the_policy(
    problem, outcome, server, tmp_path, limit, monkeypatch
):
    limit(0.5)
    run = Session.run
    monkeypatch.setattr(Session, "run", lambda *given: run(*given) or problem)
    words = ["--server", server.address, "--log", str(tmp_path / "log")]
    assert fake([*words, "--record", str(tmp_path / "data")]) == 0
    assert open_source(tmp_path / "data").episode(0).success.tolist() == [outcome]


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


@pytest.mark.parametrize(
    ("metadata", "words", "message"),
    [
        (
            {},
            ["--can", "left=a", "right=b"],
            "policy's actions have 7 numbers, but 2 PiPERs take 14",
        ),
        ({"action_dim": 14}, ["--can", "a"], "but a PiPER takes 7: two arms are --can left=can0"),
        (
            {"robot": "piper", "action_dim": 14},
            ["--can", "right=b", "left=a"],
            "of the robot piper, not of bi_piper",
        ),
        ({"robot": "piper"}, ["--arm", "piper-x"], "of the robot piper, not of piper-x"),
    ],
)
def test_a_policy_must_be_of_as_many_arms(metadata, words, message, capsys):
    with serving(Still(metadata={"action_dim": 7} | metadata)) as server:
        assert real(["--server", server.address, "--task", "press", *words]) == 2
    assert message in " ".join(capsys.readouterr().err.split())


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
        (["--task", "juggle"], "unknown task 'juggle': choose from open_pot, "),
        (["--task", "juggle"], "two_baskets, hand_over"),
        (["--latency", "0.2"], "--latency must be 0 to 0.15 s"),
        (["--speed", "9"], "at most 3 rad/s, got 9.0"),
        (["--ahead", "5"], "ahead must be 0 to 4"),
        (["--arm", "piper-x"], "the fake arm is a piper, not a piper-x"),
    ],
)
def test_the_fake_arm_refuses_wrong_options(words, message, tmp_path, capsys):
    assert fake(["--expert", "--log", str(tmp_path), *words]) == 2
    assert message in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (fake, ["--thinking", "nan"]),
        (fake, ["--noise", "-1"]),
        (fake, ["--seed", "-1"]),
        (fake, ["--execute", "0"]),
        (fake, ["--image-size", "0"]),
        (real, ["--image-size", "0"]),
        (real, ["--seconds", "inf"]),
        (real, ["--reset-time", "nan"]),
    ],
)
def test_numbers_are_checked_where_they_are_typed(command, words, capsys):
    with pytest.raises(SystemExit):
        command(words)
    assert f"argument {words[0]}: must be" in capsys.readouterr().err


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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--teach", "hand"], "--teach needs --record FOLDER"),
        (["--record", "data", "--dry-run"], "nothing to record"),
        (["--can", "left=can0"], "left=can0 right=can1, got left=can0"),
        (["--can", "can0", "can1"], "left=can0 right=can1, got can0 can1"),
        (["--can", "left=can0", "right=can0"], "got left=can0 right=can0"),
        (["--can", "left=can0", "right="], "got left=can0 right="),
        (["--can", "left=can0", "left=can1"], "got left=can0 left=can1"),
        (
            ["--arm", "piper-h", "--zeros", "urdf"],
            "--zeros urdf is for a piper: piper-h has its own",
        ),
    ],
)
def test_options_that_do_not_go_together(words, message, capsys):
    assert real(["--task", "press", *words]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
