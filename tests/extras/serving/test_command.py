"""Test the command line and what it loads."""

import contextlib
import dataclasses
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from flax import nnx
from rich.console import Console

import lorasp_jax
from lorasp_jax import models
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import native
from lorasp_jax.base.arguments import named
from lorasp_jax.extras.serving import __main__ as command
from lorasp_jax.extras.serving import loading
from lorasp_jax.extras.serving.client import PolicyClient, PolicyError, ServerGone
from lorasp_jax.peft import LoRA
from lorasp_jax.training.run_folder import to_json, write_json
from tests import ROOT
from tests.cases import mostly_slow
from tests.extras.serving.stand_in import StandIn, observation
from tests.extras.serving.test_policies import SIMULATED
from tests.models.random_models import with_noise
from tests.runs import CONFIG


def refuse(capsys, *arguments):
    assert command.main(arguments) == 2
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    return printed.err


@pytest.fixture
def run(finished):
    return finished.folder


def test_a_run_is_loaded(run):
    loaded = loading.load_run(str(run))
    assert (loaded.metadata, loaded.continues) == (SIMULATED, None)
    assert loaded.policy.processor.prompts.instructions[0] == "press the button"


def test_flow_steps_are_those_of_the_run(run, dummy_base, tmp_path):
    """Each run has its own; a published checkpoint, or a run that does not say, has ten."""

    def steps(*words):
        options = command.parser("serve").parse_args([*map(str, words), "--max-batch", "1"])
        policies, _ = command._compiled(options, dict(options.policy))
        return [policy.description.num_steps for policy in policies.values()]

    runs = []
    for number in (3, 5):
        evaluation = dataclasses.replace(CONFIG.evaluation, denoise_steps=number)
        runs.append(shutil.copytree(run, tmp_path / f"run{number}"))
        config = dataclasses.replace(CONFIG, evaluation=evaluation)
        write_json(runs[-1] / "config.json", to_json(config))
    assert steps(*runs) == [3, 5]
    assert steps(*runs, "--denoise-steps", 2) == [2, 2]
    assert steps(run) == steps(dummy_base) == [10]
    assert steps(dummy_base, "--denoise-steps", 2) == [2]


def test_a_checkpoint_is_loaded_with_and_without_adapters(dummy_base, tmp_path):
    adapted = lorasp_jax.adapt(
        models.load(dummy_base), [("q_proj", LoRA(rank=2))], rngs=nnx.Rngs(0)
    )
    graphdef, adapters, frozen = lorasp_jax.split(adapted)
    adapted = nnx.merge(graphdef, with_noise(adapters, 0.1), frozen)
    native.save_adapters(tmp_path / "ours", adapted)
    lorasp_jax.save_peft(tmp_path / "theirs", adapted, names=models.lerobot_names(adapted))
    adapters = {name: str(tmp_path / name) for name in ("ours", "theirs")}
    loaded = loading.load_checkpoint(str(dummy_base), adapters=adapters)
    adapted_paths = {n: len(adaptation.methods(each.policy.model)) for n, each in loaded.items()}
    assert adapted_paths == {"base": 0, "ours": 3, "theirs": 3}  # vision, language, action
    processor = loaded["base"].policy.processor
    assert processor.action_slots == (0, 1, 2, 3, 4, 5, 7)
    np.testing.assert_array_equal(np.asarray(processor.statistics.state["std"])[:6], 2)


@pytest.mark.parametrize(
    ("options", "refusal"),
    [
        ({"where": "assets/pi0_nano"}, "number of joints: pass --joints"),
        ({"size": "base"}, "--size are for checkpoints of openpi"),
        ({"where": "assets"}, "assets contains no model itself: .* such as .*assets/"),
        ({"statistics": str(ROOT / "tests" / "models")}, "no statistics in"),
        ({"cameras": {"top": "front"}}, "keys of cameras"),
    ],
)
def test_checkpoints_that_do_not_say_enough(options, refusal, dummy_base):
    with pytest.raises(ValueError, match=refusal):
        loading.load_checkpoint(**{"where": str(dummy_base)} | options)


@pytest.mark.parametrize(
    ("arguments", "refusal"),
    [
        (["nowhere"], "nowhere does not exist"),
        (["a=nowhere", "b=nothing"], "several policies must all be"),
        (["x/a", "y/a"], "different names"),
        (["assets/pi0_nano", "--adapter", "a=x", "--adapter", "a=y"], "different names"),
        (["a b=x"], "names must match"),
        (["x/a b"], "names must match"),
        (["assets/pi0_nano", "--adapter", "a/b=x"], "names must match"),
        (["a", "--host", "0.0.0.0"], "anyone who reaches 0.0.0.0"),
        (["a", "--token-file", "no/thing"], "no/thing: No such file"),
        (["a", "--token-file", "empty"], "empty must contain a token"),
        (["a", "--max-batch", "0"], "largest batch"),
        (["assets/pi0_nano", "--base", "x"], "--base is for runs"),
    ],
)
def test_mistakes_get_one_sentence(arguments, refusal, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").write_text("\n")
    assert refusal in refuse(capsys, *arguments, "--port", "0").replace("\n", " ")


@pytest.mark.parametrize("words", [["=x"], ["a", "--camera", "side"], ["a", "--adapter", "b="]])
def test_pairs_have_two_parts(words, capsys):
    with pytest.raises(SystemExit):
        command.main(words)
    assert f"must be NAME=VALUE, got {words[-1]!r}" in capsys.readouterr().err


def test_options_without_effect_are_refused(run, capsys):
    for words in (["--statistics", "x"], ["--joints", "6"], ["--adapter", "a=x"]):
        assert f"{words[0]} is for" in refuse(capsys, str(run), *words, "--port", "0")


def test_names_of_policies(tmp_path):
    assert named("runs/press") == ("press", "runs/press")
    assert named("a=runs/press") == ("a", "runs/press")
    (tmp_path / "lr=0.1").mkdir()
    assert named(str(tmp_path / "lr=0.1")) == ("lr=0.1", str(tmp_path / "lr=0.1"))


def test_without_a_seed_every_server_draws_one(run, capsys, monkeypatch):
    seeds = []

    class Stop(Exception):
        pass

    def serve(policies, *, seed, **_):
        seeds.append(seed)
        raise Stop

    monkeypatch.setattr(command, "_compiled", lambda options, named: ({}, None))
    monkeypatch.setattr("lorasp_jax.extras.serving.served.ServedPolicies", serve)
    for words in (["--seed", "0"], [], []):
        with pytest.raises(Stop):
            command._load(command.parser("serve").parse_args([str(run), *words]), Console())
        assert f"with --seed {seeds[-1]}" in capsys.readouterr().out
    assert seeds[0] == 0
    assert len(set(seeds)) == 3


@pytest.mark.parametrize("policy", mostly_slow(["compiled", "stand-in"], ["stand-in"]))
def test_serving_a_run_until_an_interrupt(run, capsys, monkeypatch, policy):
    """The client is in a thread, as signals reach only the main one."""
    if policy == "stand-in":
        stand_in = StandIn(adapters=("trained",), metadata={"robot": "piper"})
        monkeypatch.setattr(command, "_load", lambda *_: stand_in)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def ask():
        try:
            with PolicyClient(f"ws://127.0.0.1:{port}", wait=300) as client:
                found.update(client.metadata, shape=client.infer(observation())["actions"].shape)
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    found = {}
    thread = threading.Thread(target=ask)
    thread.start()
    words = ["--port", str(port), "--max-batch", "1", "--denoise-steps", "1"]
    assert command.main([str(run), *words]) == 0
    thread.join()
    assert (found["adapters"], found["robot"]) == (["trained"], "piper")
    assert found["denoise_steps"] == {"trained": 1 if policy == "compiled" else 10}
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[-2:]] == ["listening", "closing"]
    if policy == "compiled":
        assert found["shape"] == (4, 7)
        assert [line.split()[0] for line in lines[:-2]] == ["loading", "compiling", "ready"]
        assert re.fullmatch(rf"loading {run} with --seed \d+", lines[0])


@pytest.mark.parametrize("before", [None, "mine"])
def test_nobody_else_can_read_the_token(before, tmp_path, capsys):
    path = tmp_path / "token.txt"
    if before:
        path.write_text(f"{before}\n")
        path.chmod(0o644)
    token = command._read_token(path, Console())
    assert path.stat().st_mode & 0o777 == 0o600
    assert "token.txt" in capsys.readouterr().out.replace("\n", "")
    assert token == before if before else len(token) > 30
    assert command._read_token(path, Console()) == token
    assert not capsys.readouterr().out


HUNG = """
import sys, threading
from lorasp_jax.extras.serving import __main__ as command
from tests.extras.serving.stand_in import StandIn
policy = StandIn()
policy.gate.clear()
command.GRACE, command._load = float(sys.argv[1]), lambda *_: policy
sys.exit(command.main(["x", "--port", "0"]))
"""


@pytest.mark.parametrize(("grace", "signals"), [(0.2, 1), (600, 2)])
def test_a_hung_policy_does_not_keep_the_server_alive(grace, signals):
    """The first signal gives it some time, the second ends the process at once."""
    words = [sys.executable, "-c", HUNG, str(grace)]
    pipes = {"stdout": subprocess.PIPE, "cwd": ROOT, "text": True}
    with subprocess.Popen(words, **pipes) as process, contextlib.ExitStack() as stack:
        stack.callback(process.kill)
        address = process.stdout.readline().split()[-1]
        client = stack.enter_context(PolicyClient(address, timeout=60))

        def ask():
            with contextlib.suppress(PolicyError, ServerGone):
                client.infer(observation())

        thread = threading.Thread(target=ask)
        thread.start()
        time.sleep(0.2)  # until the policy has the request
        for number in range(signals):
            process.send_signal(signal.SIGTERM)
            if number == 0:
                assert process.stdout.readline() == "closing connections\n"
        assert process.wait(30) == (1 if signals == 1 else -signal.SIGTERM)
        assert ("has not answered within" in process.stdout.read()) == (signals == 1)
        thread.join()
