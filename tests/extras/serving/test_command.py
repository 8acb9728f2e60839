"""Test the command line and what it loads."""

import re
import signal
import subprocess
import sys
import types

import numpy as np
import pytest
from flax import nnx
from rich.console import Console

import lorasp_jax
from lorasp_jax import models
from lorasp_jax.adapters import adaptation
from lorasp_jax.adapters.io import native
from lorasp_jax.extras.serving import __main__ as command
from lorasp_jax.extras.serving import loading
from lorasp_jax.extras.serving.client import PolicyClient
from lorasp_jax.extras.serving.loading import Checkpoint
from lorasp_jax.peft import LoRA
from lorasp_jax.training import export
from lorasp_jax.training.run_folder import write_json
from tests import ROOT
from tests.models.random_models import with_noise


def refuse(capsys, *arguments):
    assert command.main(arguments) == 2
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    return printed.err


def test_a_run_is_loaded(run):
    loaded = loading.load_runs({"a": str(run), "b": str(run)})
    assert list(loaded.policies) == list(loaded.words) == ["a", "b"]
    assert loaded.metadata == {"robot": "piper", "control_dt": 0.1}
    assert loaded.policies["a"].processor.prompts.instructions[0] == "press the button"


def test_only_trained_runs_can_continue_chunks_as_trained(tmp_path):
    write_json(tmp_path / "config.json", {"optim": {"rtc_max_delay": 2}})
    loading.check_trained([str(tmp_path)])
    write_json(tmp_path / "config.json", {"optim": {}})
    with pytest.raises(ValueError, match=r"was not trained to continue chunks"):
        loading.check_trained([str(tmp_path)])


def test_runs_of_different_robots_are_not_served_together(run, tmp_path, monkeypatch):
    described = export.describe(run)
    other = iter([described, {**described, "robot": "panda"}])
    monkeypatch.setattr(export, "describe", lambda _: next(other))
    with pytest.raises(ValueError, match="must agree on robot and control_dt"):
        loading.load_runs({"a": str(run), "b": str(run)})


def test_a_checkpoint_is_loaded_with_and_without_adapters(base, tmp_path):
    adapted = lorasp_jax.adapt(models.load(base), [("q_proj", LoRA(rank=2))], rngs=nnx.Rngs(0))
    graphdef, adapters, frozen = lorasp_jax.split(adapted)
    adapted = nnx.merge(graphdef, with_noise(adapters, 0.1), frozen)
    native.save_adapters(tmp_path / "ours", adapted)
    checkpoint = Checkpoint(str(base), adapters={"mine": str(tmp_path / "ours")})
    loaded = loading.load_checkpoint(checkpoint)
    assert list(loaded.policies) == ["base", "mine"]
    adapted_paths = [len(adaptation.methods(policy.model)) for policy in loaded.policies.values()]
    assert adapted_paths == [0, 3]  # vision, language, action
    processor = loaded.policies["base"].processor
    assert processor.robot_slots == (0, 1, 2, 3, 4, 5, 7)
    np.testing.assert_array_equal(np.asarray(processor.statistics.state["std"])[:6], 2)


def test_checkpoints_that_do_not_say_enough(base):
    with pytest.raises(ValueError, match="do not show the robot's number of joints: pass --joints"):
        loading.load_checkpoint(Checkpoint("assets/pi0_nano"))
    with pytest.raises(ValueError, match="unknown size 'huge': choose one of nano, small, base"):
        loading.load_checkpoint(Checkpoint(str(base), size="huge"))
    with pytest.raises(ValueError, match="no statistics in"):
        loading.load_checkpoint(Checkpoint(str(base), statistics=str(ROOT / "tests" / "models")))
    with pytest.raises(ValueError, match="keys of cameras must be one or more of"):
        loading.load_checkpoint(Checkpoint(str(base), cameras={"top": "front"}))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nowhere"], "nowhere does not exist"),
        (
            ["a=nowhere", "b=nothing"],
            "several policies must all be finished runs, or all be exported",
        ),
        (["x/a", "y/a"], "the policies must have different names: pass NAME=POLICY"),
        (["a", "--host", "0.0.0.0"], "anyone who reaches 0.0.0.0 could use the policy"),
        (["a", "--certificate", "x"], "--certificate and --key must be given together"),
        (["a", "--certificate", "x", "--key", "y"], "cannot use x with y"),
        (["a", "--token-file", "nothing"], "nothing: No such file"),
        (["a", "--max-batch", "0"], "the largest batch must be at least 1"),
        (["=x"], "expected NAME=VALUE, got '=x'"),
        (["assets/pi0_nano", "--base", "x"], "--base is for runs"),
        (["assets/pi0_nano", "--camera", "side"], "expected NAME=VALUE, got 'side'"),
    ],
)
def test_mistakes_get_one_sentence(arguments, sentence, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert sentence in refuse(capsys, *arguments, "--port", "0").replace("\n", " ")


def test_options_without_effect_are_refused(run, capsys):
    for option in ("--statistics", "--joints", "--adapter"):
        error = refuse(capsys, str(run), option, "1", "--port", "0").replace("\n", " ")
        assert f"{option} is for published checkpoints: runs record theirs" in error


def test_names_of_policies(tmp_path):
    assert command._named("runs/press") == ("press", "runs/press")
    assert command._named("a=runs/press") == ("a", "runs/press")
    (tmp_path / "lr=0.1").mkdir()
    assert command._named(str(tmp_path / "lr=0.1")) == ("lr=0.1", str(tmp_path / "lr=0.1"))


def test_without_a_seed_every_server_draws_one(run, capsys, monkeypatch):
    seeds, nothing = [], types.SimpleNamespace(adapters=(), sizes=(), warm_up=lambda report: None)

    def compiled(options, named):
        seeds.append(options.seed)
        return nothing, {}

    monkeypatch.setattr(command, "_compiled", compiled)
    for words in (["--seed", "0"], [], []):
        command._load(command.parser("serve").parse_args([str(run), *words]), Console())
        assert f"with --seed {seeds[-1]}" in capsys.readouterr().out
    assert seeds[0] == 0
    assert len(set(seeds)) == 3


def test_an_empty_token_is_refused(tmp_path, capsys):
    (tmp_path / "token").write_text("\n")
    error = refuse(capsys, "a", "--token-file", str(tmp_path / "token"))
    assert "must contain a token of printable ASCII characters" in error


def test_missing_libraries_are_named(monkeypatch, capsys):
    monkeypatch.delitem(sys.modules, "lorasp_jax.extras.serving.server")
    monkeypatch.delattr(sys.modules["lorasp_jax.extras.serving"], "server")
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    monkeypatch.setitem(sys.modules, "msgpack", None)
    monkeypatch.delitem(sys.modules, "lorasp_jax.extras.serving.wire", raising=False)
    assert 'pip install "lorasp_jax[serving]"' in refuse(capsys, "a")


def test_serving_a_run_until_an_interrupt(run):
    arguments = [str(run), "--port", "0", "--max-batch", "1", "--num-steps", "1"]
    process = subprocess.Popen(
        [sys.executable, "-m", "lorasp_jax.extras.serving", *arguments],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    with process:
        lines = []
        while not lines or not lines[-1].startswith("listening on "):
            line = process.stdout.readline()
            assert line, lines
            lines.append(line)
        assert [line.split()[0] for line in lines] == ["loading", "compiling", "ready", "listening"]
        assert re.fullmatch(rf"loading {run} with --seed \d+\n", lines[0])
        with PolicyClient(lines[-1].split()[-1]) as client:
            assert client.metadata["adapters"] == ["trained"]
            assert client.metadata["robot"] == "piper"
            picture = np.zeros((48, 64, 3), np.uint8)
            reply = client.infer(
                {
                    "image": {"side": picture, "wrist": picture},
                    "state": np.zeros(7),
                    "prompt": "push the button",
                }
            )
            assert reply["actions"].shape == (4, 7)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
        assert process.stdout.read() == "closing connections\n"
